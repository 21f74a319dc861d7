"""Camera matrices as they should have been written."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from deltas_nets.captures.frame import FloatArray, Frame

__all__ = ["moved_centre", "of_shape", "of_size", "swapped", "with_K", "with_focal"]


def of_size(K: FloatArray, factor: float) -> FloatArray:
    """K of images ``factor`` times as large; pixel centres stay at integers."""
    half = factor / 2 - 0.5
    scaled: FloatArray = np.array([[factor, 0, half], [0, factor, half], [0, 0, 1]]) @ K
    return scaled


def of_shape(K: FloatArray, old_size: tuple[int, int], new_size: tuple[int, int]) -> FloatArray:
    """K of images ``(height, width)`` that are resized, each side by its own factor."""
    down, right = (new / old for new, old in zip(new_size, old_size, strict=True))
    resized: FloatArray = (
        np.array([[right, 0, right / 2 - 0.5], [0, down, down / 2 - 0.5], [0, 0, 1]]) @ K
    )
    return resized


def with_focal(K: FloatArray, factor: float) -> FloatArray:
    """K of a lens with a longer focal length; the principal point stays."""
    changed = K.copy()
    changed[[0, 1], [0, 1]] *= factor
    return changed


def moved_centre(frame: Frame, shift: float) -> Frame:
    """The frame with its principal point moved, by as much on both axes."""
    K = frame.K.copy()
    K[:2, 2] += shift
    return replace(frame, K=K)


def swapped(K: FloatArray) -> FloatArray:
    """K with x and y exchanged."""
    order = [1, 0, 2]
    exchanged: FloatArray = K[order][:, order]
    return exchanged


def with_K(right: Mapping[int, FloatArray | None]) -> Callable[[int, Frame], Frame]:
    """A change of frames, by position, to the K that is right; None leaves one alone."""

    def change(position: int, frame: Frame) -> Frame:
        K = right.get(position)
        return frame if K is None else replace(frame, K=K)

    return change
