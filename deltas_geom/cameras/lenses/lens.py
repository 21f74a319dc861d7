"""A camera whose image is not straight: points to pixels, pixels to rays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from deltas_geom.cameras.lenses.models import MODELS
from deltas_geom.cameras.lenses.parameters import from_parameters, in_a_row, opencv, to_parameters
from deltas_geom.cameras.lenses.through import pixels_of_points, rays_of_pixels
from deltas_geom.checks import ShapeError, check_shapes
from deltas_geom.records import Record


class LensPixels(Record):
    """Where points appear through a lens.

    Attributes:
        pixels: ``(*B, N, 2)``; (0, 0) with zero gradient where there is none.
        valid: ``(*B, N)`` bool.
    """

    pixels: Tensor
    valid: Tensor


class LensRays(Record):
    """The rays that a lens bends to pixels.

    Attributes:
        rays: ``(*B, N, 3)`` of length 1 in the camera's frame, z negative beyond 90 degrees; (0,
            0, 0) with zero gradient where there is none.
        valid: ``(*B, N)`` bool.
    """

    rays: Tensor
    valid: Tensor


@dataclass(frozen=True, eq=False)
class Lens:
    """Cameras with the distortion of one of COLMAP's models.

    Attributes:
        K: ``(*B, 3, 3)`` intrinsics in pixels; pixel centres are integers. Of EQUIRECTANGULAR
            focal lengths are px/rad.
        coefficients: ``(*B, C)`` in COLMAP's order, without focal lengths and principal point;
            C = 0 where the model has none.
        model: COLMAP's name; ``deltas_geom.Lens.models()`` has all of them.

    Raises:
        ShapeError: a trailing shape differs, or the model has another number of coefficients.
        ValueError: no such model; the nearest name is told.

    Example:
        >>> K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
        >>> lens = Lens(K, torch.tensor([-0.3, 0.1, 0.0, 0.0]), "OPENCV")
        >>> pixels, valid = lens.project(torch.tensor([[0.5, 0.0, 1.0]]))
        >>> pixels
        tensor([[299.6875, 120.0000]])
        >>> lens.unproject(pixels).rays * 1.25**0.5
        tensor([[0.5000, 0.0000, 1.0000]])
    """

    K: Tensor
    coefficients: Tensor
    model: str

    def __post_init__(self) -> None:
        wanted = self.coefficient_names(self.model)
        check_shapes(K=(self.K, "3 3"), coefficients=(self.coefficients, "C"))
        count = self.coefficients.shape[-1]
        if count != len(wanted):
            listed = f" ({' '.join(wanted)})" if wanted else ""
            raise ShapeError(
                f"coefficients of {self.model} must be {len(wanted)}{listed}, got {count}"
            )

    @staticmethod
    def models() -> list[str]:
        """The names of all models."""
        return list(MODELS)

    @staticmethod
    def coefficient_names(model: str) -> tuple[str, ...]:
        """The names of a model's coefficients, in order.

        Raises:
            ValueError: no such model.
        """
        if model not in MODELS:
            import difflib

            named = str(model).upper().replace("-", "_")
            near = difflib.get_close_matches(named, MODELS, n=1, cutoff=0.4)
            cure = f"did you mean {near[0]}?" if near else f"take one of {list(MODELS)}"
            raise ValueError(f"no camera model {model!r}: {cure}")
        return MODELS[model].coefficients

    def project(self, points: Tensor) -> LensPixels:
        """Pixels of points in the camera's own frame.

        Args:
            points: ``(*B, N, 3)``, z forward; of any unit. ``*B`` broadcasts with the lens's.

        Returns:
            Not valid are points behind a lens that does not look there, points beyond where its
            polynomial turns back (there another point has the same pixel), and what is not finite.

        Raises:
            ShapeError: a trailing shape differs, or batch dims do not broadcast.
        """
        return LensPixels(*pixels_of_points(self.K, self.coefficients, points, self.model))

    def unproject(self, pixels: Tensor) -> LensRays:
        """Rays of pixels in the camera's own frame, of length 1.

        Derivatives follow from the equation that the ray solves (implicit function theorem), so
        they cost one more step, however the ray was found; first and second ones are right.

        Args:
            pixels: ``(*B, N, 2)``. ``*B`` broadcasts with the lens's.

        Returns:
            Not valid are pixels that no point of the lens's domain projects to, as in the corners
            of an image whose polynomial turns back before them, and what is not finite.

        Raises:
            ShapeError: a trailing shape differs, or batch dims do not broadcast.

        Example:
            Rays of any lens go into triangulation:

            >>> from deltas_geom import triangulate_rays
            >>> K = torch.tensor([[200.0, 0, 160], [0, 200, 120], [0, 0, 1]])
            >>> lens = Lens(K, torch.tensor([0.05, -0.01, 0.0, 0.0]), "OPENCV_FISHEYE")
            >>> poses = torch.eye(4).repeat(2, 1, 1)
            >>> poses[1, 0, 3] = -0.2  # the second camera stands 20 cm to the right
            >>> points = torch.tensor([[0.2, 0.1, 0.5], [3.0, 0.0, -0.1]])  # one beside it
            >>> seen = lens.project(points + poses[:, None, :3, 3])
            >>> rays, valid = lens.unproject(seen.pixels)
            >>> triangulate_rays(poses, rays, mask=valid).points.allclose(points, atol=1e-4)
            True
        """
        return LensRays(*rays_of_pixels(self.K, self.coefficients, pixels, self.model))

    @classmethod
    def from_opencv(cls, K: Tensor, dist: Tensor) -> Self:
        """From what ``cv2.calibrateCamera`` returns: OPENCV, FULL_OPENCV or OPENCV_THIN_PRISM.

        Args:
            K: ``(*B, 3, 3)``; OpenCV's pixel centres are at integers, as ours.
            dist: ``(*B, D)`` in OpenCV's order: k1 k2 p1 p2 (k3 (k4 k5 k6 (s1 s2 s3 s4 (tx ty)))),
                so D is 4, 5, 8, 12 or 14; OpenCV's own (1, D) and (D, 1) are read as (D).

        Raises:
            ShapeError: another number of coefficients.
            ValueError: the tilt of the sensor, tx and ty, is not 0.

        Example:
            >>> dist = torch.tensor([-0.3, 0.1, 0.001, 0.0, -0.02])
            >>> Lens.from_opencv(torch.eye(3), dist).model
            'FULL_OPENCV'
        """
        return cls(*opencv(K, dist))

    @classmethod
    def from_opencv_fisheye(cls, K: Tensor, dist: Tensor) -> Self:
        """From what ``cv2.fisheye.calibrate`` returns: K ``(*B, 3, 3)`` and k1..k4 ``(*B, 4)``.

        Raises:
            ShapeError: another number of coefficients.
        """
        return cls(K, in_a_row(K, dist), "OPENCV_FISHEYE")

    @classmethod
    def from_colmap(cls, model: str, params: Tensor | Sequence[float]) -> Self:
        """From a line of COLMAP's ``cameras.txt``.

        Args:
            model: its name.
            params: ``(*B, P)`` as COLMAP lists them, or numbers: focal lengths, principal point
                (which COLMAP counts from the corner of the image, so that pixel centres are at
                0.5; K has 0.5 less) and coefficients; of EQUIRECTANGULAR width and height.

        Raises:
            ShapeError: another number of parameters than the model's.
            ValueError: no such model; the nearest name is told.

        Example:
            >>> lens = Lens.from_colmap("SIMPLE_RADIAL", [300.0, 160.0, 120.0, -0.1])
            >>> lens.K
            tensor([[300.0000,   0.0000, 159.5000],
                    [  0.0000, 300.0000, 119.5000],
                    [  0.0000,   0.0000,   1.0000]])
        """
        cls.coefficient_names(model)
        if not isinstance(params, Tensor):
            params = torch.tensor(params, dtype=torch.get_default_dtype())
        return cls(*from_parameters(model, params), model)

    def to_colmap(self) -> Tensor:
        """The parameters ``(*B, P)`` that COLMAP lists for the model.

        A skew is lost; of models with one focal length it is that of x.
        """
        return to_parameters(self.model, self.K, self.coefficients)

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """K and coefficients moved as by :meth:`torch.Tensor.to`."""
        return type(self)(
            self.K.to(*args, **kwargs), self.coefficients.to(*args, **kwargs), self.model
        )

    def detach(self) -> Self:
        """The same without gradients."""
        return type(self)(self.K.detach(), self.coefficients.detach(), self.model)

    @property
    def device(self) -> torch.device:
        """Of K, as of both."""
        return self.K.device

    @property
    def dtype(self) -> torch.dtype:
        """Of K."""
        return self.K.dtype


# torch.load refuses classes that it has not been told of.
torch.serialization.add_safe_globals([Lens])
