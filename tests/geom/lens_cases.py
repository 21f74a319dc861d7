"""One lens of each model as cameras have it, some that turn back, and oracles in NumPy."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_geom import Lens

Array = NDArray[Any]
SIZE = (960, 1280)
STRAIGHT = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_FISHEYE", "FISHEYE", "EQUIRECTANGULAR"]


class Case(NamedTuple):
    """A model, its coefficients, and the share of the image that it can see."""

    model: str
    coefficients: tuple[float, ...] = ()
    share: float = 1.0
    focal: float = 500.0

    def lens(self, dtype: torch.dtype = torch.float64) -> Lens:
        fx, fy = self.focal, 1.02 * self.focal
        cx, cy = 655.0, 470.0
        if self.model == "EQUIRECTANGULAR":
            fx, fy, cx, cy = SIZE[1] / (2 * np.pi), SIZE[0] / np.pi, 639.5, 479.5
        if not self.model.startswith(("OPENCV", "FULL", "PINHOLE", "FISHEYE", "FOV", "DIV", "EU")):
            fy = fx if self.model != "EQUIRECTANGULAR" else fy
        K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
        coefficients = torch.tensor(self.coefficients, dtype=torch.float64)
        return Lens(K, coefficients, self.model).to(dtype)


CASES: dict[str, Case] = {
    case.model: case
    for case in [
        *(Case(model) for model in STRAIGHT),
        Case("SIMPLE_RADIAL", (-0.05,)),
        Case("RADIAL", (-0.3, 0.1)),
        Case("OPENCV", (-0.3, 0.1, 1e-3, -2e-3)),
        Case("FULL_OPENCV", (0.3, 0.1, 1e-3, -2e-3, 0.02, 0.4, 0.15, 0.02)),
        Case(
            "OPENCV_THIN_PRISM",
            (0.3, 0.1, 1e-3, -2e-3, 0.02, 0.5, 0.2, 0.03, 2e-3, 1e-3, -3e-3, 5e-4),
        ),
        Case("FOV", (0.9,)),
        Case("SIMPLE_DIVISION", (-0.3,)),
        Case("DIVISION", (0.2,)),
        Case("EUCM", (0.6, 1.1)),
        Case("SIMPLE_RADIAL_FISHEYE", (-0.02,)),
        Case("RADIAL_FISHEYE", (-0.03, 0.002)),
        Case("OPENCV_FISHEYE", (0.05, -0.01, 0.002, -0.0005)),
        Case("THIN_PRISM_FISHEYE", (-0.05, 0.01, 1e-3, -2e-3, 1e-3, 0, 1e-3, 2e-3)),
        Case(
            "RAD_TAN_THIN_PRISM_FISHEYE",
            (-0.05, 0.01, 1e-3, 0, 0, 0, 1e-3, -2e-3, 1e-3, 5e-4, 2e-3, -3e-4),
        ),
    ]
}
TURNING: dict[str, Case] = {
    "barrel": Case("SIMPLE_RADIAL", (-0.2,), 0.48),
    "inflection": Case("RADIAL", (-0.44, 0.1), 1.0),
    "almost": Case("RADIAL", (-0.60, 0.1835), 1.0),
    "tangential": Case("OPENCV", (-0.25, 0.0, 2e-3, -1e-3), 0.38),
    "quotient": Case("FULL_OPENCV", (0.3, 0.1, 1e-3, -2e-3, 0.02, 0.5, 0.2, 0.03), 1.0),
    "pole": Case("FULL_OPENCV", (0, 0, 0, 0, 0, -0.5, 0, 0), 1.0),
    "fisheye": Case("OPENCV_FISHEYE", (-0.1, 0, 0, 0), 0.61, 400),
    "steep fisheye": Case("THIN_PRISM_FISHEYE", (-0.2, 0, 2e-3, 1e-3, 0, 0, 1e-3, -2e-3), 0.47),
    "aria": Case("RAD_TAN_THIN_PRISM_FISHEYE", (-0.15, *(0,) * 5, 2e-3, 1e-3, 1e-3, 0, 0, 0), 0.62),
    "division": Case("SIMPLE_DIVISION", (0.6,), 0.9),
    "eucm": Case("EUCM", (0.7, 1.3), 0.96),
    "field of view": Case("FOV", (1.4,), 0.75),
}
"""Beyond a part of the image nothing is seen, or almost so."""


def pixels_of(count: int, seed: int = 0) -> Tensor:
    """Anywhere in the image."""
    height, width = SIZE
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(count, 2, dtype=torch.float64, generator=generator)
    return drawn * torch.tensor([width, height]) - 0.5


def on_plane(lens: Lens, pixels: Tensor) -> Array:
    focal, center = lens.K.diagonal()[:2], lens.K[:2, 2]
    return ((pixels - center) / focal).numpy()


def _brown(c: dict[str, float], x: Array, y: Array) -> tuple[Array, Array]:
    """OpenCV's formula, written from its documentation."""
    t = x * x + y * y
    k = lambda name: c.get(name, 0.0)  # noqa: E731
    above = 1 + k("k1") * t + k("k2") * t**2 + k("k3") * t**3
    if "k5" in c:
        above = above / (1 + k("k4") * t + k("k5") * t**2 + k("k6") * t**3)
    else:
        above = above + k("k4") * t**4
    u = x * above + 2 * k("p1") * x * y + k("p2") * (t + 2 * x * x) + k("s1") * t + k("s2") * t * t
    v = y * above + k("p1") * (t + 2 * y * y) + 2 * k("p2") * x * y + k("s3") * t + k("s4") * t * t
    return u + k("sx1") * t, v + k("sy1") * t


def distorted(case: Case) -> Callable[[Array, Array], tuple[Array, Array]]:
    """The distortion of the plane of slopes or angles, of the models that are polynomials."""
    names = [{"k": "k1"}.get(n, n) for n in Lens.coefficient_names(case.model)]
    c = dict(zip(names, case.coefficients, strict=True))
    return lambda x, y: _brown(c, x, y)


def seen_from_the_axis(case: Case, pixels: Tensor) -> Array:
    """Which pixels lie within the image of the curve at which the derivative first vanishes.

    The derivative is that of complex numbers, along 360 directions from the axis: independent of
    how the library finds points, and of how it bounds them.
    """
    place, goal = distorted(case), on_plane(case.lens(), pixels)
    turn = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    r = np.linspace(0, np.pi if "FISHEYE" in case.model else 6, 1000)[1:, None]
    x, y = r * np.cos(turn), r * np.sin(turn)
    with np.errstate(all="ignore"):
        ax, ay = (part.imag / 1e-30 for part in place(x + 1e-30j, y))
        bx, by = (part.imag / 1e-30 for part in place(x, y + 1e-30j))
        u, v = place(x, y)
    # Beyond a pole the plane is turned inside out.
    ends = ~(ax * by - bx * ay > 0) | (u * x + v * y < 0)
    last = np.where(ends.any(0), ends.argmax(0), len(r)) - 1
    u, v = (np.take_along_axis(part, last[None], 0)[0] for part in (u, v))
    inside = np.zeros(len(goal), bool)
    for k in range(len(u)):
        (x0, y0), (x1, y1) = (u[k - 1], v[k - 1]), (u[k], v[k])
        between = (y0 > goal[:, 1]) != (y1 > goal[:, 1])
        with np.errstate(all="ignore"):
            inside ^= between & (goal[:, 0] < x0 + (goal[:, 1] - y0) * (x1 - x0) / (y1 - y0))
    return inside
