"""The table of camera models, by COLMAP's names: a new model is a row here, and its functions.

Source: COLMAP's src/colmap/sensor/models.h states each model; OPENCV_THIN_PRISM is OpenCV's with
twelve coefficients, for which COLMAP has no name.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.lenses import closed
from deltas_geom.cameras.lenses.closed import Coefficients, Direction, Seen
from deltas_geom.cameras.lenses.polynomial import Polynomial


class Model(NamedTuple):
    """What a name stands for.

    Attributes:
        coefficients: their names, in COLMAP's order.
        focals: how many focal lengths COLMAP writes before the principal point: 1 or 2.
        pixels: from coefficients, the reach and a point: its place on the plane, and whether.
        rays: from coefficients, the reach, a place on the plane and whether a gradient is wanted:
            the unit ray, and whether.
        reach: from coefficients, how far the model is one to one, ``(*B, R)``.
        around_axis: do rays turn with their places around the axis?
        undone: of the same as for rays, the place for them, where the plane is distorted itself.
    """

    coefficients: tuple[str, ...]
    focals: int
    pixels: Callable[[Coefficients, Tensor, Tensor, Tensor, Tensor], Seen]
    rays: Callable[[Coefficients, Tensor, Tensor, Tensor, bool], Direction]
    reach: Callable[[Coefficients], Tensor] | None = None
    around_axis: bool = True
    undone: Callable[[Coefficients, Tensor, Tensor, Tensor, bool], Seen] | None = None


def _closed(
    names: str,
    focals: int,
    pixels: Callable[[Coefficients, Tensor, Tensor, Tensor], Seen],
    rays: Callable[[Coefficients, Tensor, Tensor], Direction],
) -> Model:
    def rays_of_length_one(
        coefficients: Coefficients, _: Tensor, u: Tensor, v: Tensor, derivable: bool
    ) -> Direction:
        x, y, z, known = rays(coefficients, u, v)
        inverse = torch.addcmul(torch.addcmul(x * x, y, y), z, z).rsqrt()
        return x * inverse, y * inverse, z * inverse, known

    return Model(
        tuple(names.split()),
        focals,
        lambda coefficients, _, x, y, z: pixels(coefficients, x, y, z),
        rays_of_length_one,
        around_axis=pixels is not closed.panorama_pixels,
    )


def _distorted(names: str, focals: int, kind: Polynomial) -> Model:
    parts = (kind.pixels, kind.rays, kind.reach, kind.around_axis)
    undone = kind.undone if kind.steps[1:] else None
    return Model(tuple(names.split()), focals, *parts, undone)


def _slopes(names: str, focals: int = 2, /, **kinds: str) -> Model:
    return _distorted(names, focals, Polynomial.named(names, kinds, angles=False))


def _angles(names: str, focals: int = 2, /, *later: dict[str, str], **kinds: str) -> Model:
    return _distorted(names, focals, Polynomial.named(names, kinds, *later, angles=True))


_RATIONAL = "k1 k2 p1 p2 k3 k4 k5 k6"
_QUOTIENT = {"radial": "k1 k2 k3", "divided": "k4 k5 k6", "tangential": "p2 p1"}
_TANGENTIAL = "p2 p1"  # the coefficient of 3 x^2 + y^2 comes second

MODELS: dict[str, Model] = {
    "SIMPLE_PINHOLE": _closed("", 1, closed.pinhole_pixels, closed.pinhole_rays),
    "PINHOLE": _closed("", 2, closed.pinhole_pixels, closed.pinhole_rays),
    "SIMPLE_RADIAL": _slopes("k", 1, radial="k"),
    "RADIAL": _slopes("k1 k2", 1, radial="k1 k2"),
    "OPENCV": _slopes("k1 k2 p1 p2", radial="k1 k2", tangential=_TANGENTIAL),
    "FULL_OPENCV": _slopes(_RATIONAL, **_QUOTIENT),
    "OPENCV_THIN_PRISM": _slopes(f"{_RATIONAL} s1 s2 s3 s4", prism="s1 s3 s2 s4", **_QUOTIENT),
    "FOV": _closed("omega", 2, closed.fov_pixels, closed.fov_rays),
    "SIMPLE_DIVISION": _closed("k", 1, closed.division_pixels, closed.division_rays),
    "DIVISION": _closed("k", 2, closed.division_pixels, closed.division_rays),
    "EUCM": _closed("alpha beta", 2, closed.eucm_pixels, closed.eucm_rays),
    "SIMPLE_FISHEYE": _angles("", 1),
    "FISHEYE": _angles(""),
    "SIMPLE_RADIAL_FISHEYE": _angles("k", 1, radial="k"),
    "RADIAL_FISHEYE": _angles("k1 k2", 1, radial="k1 k2"),
    "OPENCV_FISHEYE": _angles("k1 k2 k3 k4", radial="k1 k2 k3 k4"),
    "THIN_PRISM_FISHEYE": _angles(
        "k1 k2 p1 p2 k3 k4 sx1 sy1", radial="k1 k2 k3 k4", tangential=_TANGENTIAL, prism="sx1 sy1"
    ),
    # Source: https://facebookresearch.github.io/projectaria_tools, "Fisheye624".
    "RAD_TAN_THIN_PRISM_FISHEYE": _angles(
        "k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
        2,
        {"tangential": "p0 p1", "prism": "s0 s2 s1 s3"},
        radial="k0 k1 k2 k3 k4 k5",
    ),
    "EQUIRECTANGULAR": _closed("", 2, closed.panorama_pixels, closed.panorama_rays),
}
"""COLMAP writes width and height in place of the focal lengths of EQUIRECTANGULAR."""
