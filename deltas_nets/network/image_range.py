"""Whether images are what the network was trained with: RGB in [0, 1]."""

from torch import Tensor

from deltas_geom.numerics.arithmetic import values_at_hand

LOWEST, HIGHEST = -1.0, 2.0
"""Resizing and noise overshoot [0, 1] a little; no other range of images stays within these."""


def check_images(images: Tensor) -> None:
    """Refuse integers and other ranges, of which the network would make confident nonsense.

    Values are looked at where that is free: on the CPU, and not while the network is traced. NaN is
    no range and is let through, and so is what it hides; it ends up in the prediction.

    Raises:
        TypeError: the images are integers.
        ValueError: they are not in [0, 1], but for example in 0..255.
    """
    if not images.is_floating_point():
        raise TypeError(f"images must be floating point in [0, 1], got {images.dtype}")
    if not values_at_hand(images) or not images.numel():
        return
    low, high = (float(bound) for bound in images.detach().aminmax())
    if low < LOWEST or high > HIGHEST:
        raise ValueError(
            f"images must be RGB in [0, 1], got values from {low:g} to {high:g}: divide those in "
            "0..255 by 255, and do not normalise them"
        )
