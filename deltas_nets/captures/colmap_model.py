"""A model as COLMAP keeps it: cameras, images, points, and its conventions.

COLMAP puts the corner of the image at pixel (0, 0), we the centre of its first pixel: records here
are COLMAP's, `k_and_lens` and `camera_of` go between them and ours.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.frame import FloatArray, Lens

__all__ = [
    "CAMERA_MODELS",
    "NO_POINT",
    "CameraModel",
    "ColmapCamera",
    "ColmapImages",
    "ColmapModel",
    "ColmapPoints",
    "ColmapTracks",
    "camera_of",
    "k_and_lens",
    "model_of_id",
]

NO_POINT = -1
"""The point of a pixel that has none."""


class CameraModel(NamedTuple):
    """One of COLMAP's camera models.

    Attributes:
        id: in binary files.
        num_focal: 1 where both focal lengths are one number, else 2; 0 where there is none.
        num_coefficients: after the principal point.
        straight: whether coefficients of 0 leave straight lines straight.
    """

    id: int
    num_focal: int
    num_coefficients: int
    straight: bool

    @property
    def num_params(self) -> int:
        """Numbers that a file states."""
        return self.num_focal + 2 + self.num_coefficients


CAMERA_MODELS: Mapping[str, CameraModel] = {
    "SIMPLE_PINHOLE": CameraModel(0, 1, 0, True),
    "PINHOLE": CameraModel(1, 2, 0, True),
    "SIMPLE_RADIAL": CameraModel(2, 1, 1, True),
    "RADIAL": CameraModel(3, 1, 2, True),
    "OPENCV": CameraModel(4, 2, 4, True),
    "OPENCV_FISHEYE": CameraModel(5, 2, 4, False),
    "FULL_OPENCV": CameraModel(6, 2, 8, True),
    "FOV": CameraModel(7, 2, 1, True),
    "SIMPLE_RADIAL_FISHEYE": CameraModel(8, 1, 1, False),
    "RADIAL_FISHEYE": CameraModel(9, 1, 2, False),
    "THIN_PRISM_FISHEYE": CameraModel(10, 2, 8, False),
    "RAD_TAN_THIN_PRISM_FISHEYE": CameraModel(11, 2, 12, False),
    "SIMPLE_DIVISION": CameraModel(12, 1, 1, True),
    "DIVISION": CameraModel(13, 2, 1, True),
    "SIMPLE_FISHEYE": CameraModel(14, 1, 0, False),
    "FISHEYE": CameraModel(15, 2, 0, False),
    "EUCM": CameraModel(16, 2, 2, False),
    "EQUIRECTANGULAR": CameraModel(17, 0, 0, False),
}
"""By name, as of COLMAP 4.2. The two numbers of EQUIRECTANGULAR are the image's size."""


class ColmapCamera(NamedTuple):
    """A camera: one of `CAMERA_MODELS`, (height, width), and the model's numbers."""

    model: str
    image_size: tuple[int, int]
    params: tuple[float, ...]


class ColmapImages(NamedTuple):
    """I images.

    Attributes:
        ids: ``(I,)``.
        names: of the files, from the folder of images.
        quaternions: ``(I, 4)`` of cam_from_world, w first, of any length.
        translations: ``(I, 3)`` of cam_from_world.
        camera_ids: ``(I,)``.
    """

    ids: NDArray[np.int64]
    names: list[str]
    quaternions: FloatArray
    translations: FloatArray
    camera_ids: NDArray[np.int64]


class ColmapPoints(NamedTuple):
    """P points.

    Attributes:
        ids: ``(P,)``.
        xyz: ``(P, 3)``.
        rgb: ``(P, 3)``.
        error: ``(P,)`` px; -1 where not known.
    """

    ids: NDArray[np.int64]
    xyz: FloatArray
    rgb: NDArray[np.uint8]
    error: FloatArray

    @classmethod
    def none(cls) -> "ColmapPoints":
        """No point."""
        nothing = np.zeros((0, 3))
        return cls(np.zeros(0, np.int64), nothing, nothing.astype(np.uint8), np.zeros(0))


class ColmapTracks(NamedTuple):
    """T pixels in which images see points, those of each image together and in its order.

    Attributes:
        image: ``(T,)`` position of the image.
        pixels: ``(T, 2)``, the image's corner at (0, 0).
        point_ids: ``(T,)``; pixels without a point are left out.
    """

    image: NDArray[np.int64]
    pixels: FloatArray
    point_ids: NDArray[np.int64]


class ColmapModel(NamedTuple):
    """What a folder of cameras, images and points3D holds."""

    cameras: Mapping[int, ColmapCamera]
    images: ColmapImages
    points: ColmapPoints
    tracks: ColmapTracks


def model_of_id(id: int) -> str | None:
    """The name of a model in binary files."""
    return next((name for name, model in CAMERA_MODELS.items() if model.id == id), None)


def k_and_lens(camera: ColmapCamera) -> tuple[FloatArray, Lens | None]:
    """``(3, 3)`` intrinsics with pixel centres at integers, and a lens that bends lines.

    A panorama's pixels are K times (longitude, latitude, 1): its K says how many to the radian.

    Example:
        >>> K, lens = k_and_lens(ColmapCamera("SIMPLE_RADIAL", (480, 640), (500, 320, 240, -0.1)))
        >>> K.tolist(), lens
        ([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]],
        Lens(model='SIMPLE_RADIAL', coefficients=(-0.1,)))
    """
    model, numbers = CAMERA_MODELS[camera.model], camera.params
    if model.num_focal == 0:
        height, width = camera.image_size
        numbers = (width / (2 * np.pi), height / np.pi, width / 2, height / 2)
    focal = numbers[:1] * 2 if model.num_focal == 1 else numbers[:2]
    cx, cy, *bends = numbers[model.num_focal or 2 :]
    K = np.array([[focal[0], 0, cx - 0.5], [0, focal[1], cy - 0.5], [0, 0, 1.0]])
    K.setflags(write=False)
    lens = None if model.straight and not any(bends) else Lens(camera.model, tuple(bends))
    return K, lens


def camera_of(K: FloatArray, lens: Lens | None, image_size: tuple[int, int]) -> ColmapCamera | None:
    """The camera that COLMAP would write; None where none of its models is like that.

    Models with one focal length become such with two where those of K differ.
    """
    name = "PINHOLE" if lens is None else lens.model
    bends = () if lens is None else lens.coefficients
    if name == "EQUIRECTANGULAR":
        return ColmapCamera(name, image_size, (float(image_size[1]), float(image_size[0])))
    if name in CAMERA_MODELS and CAMERA_MODELS[name].num_focal == 1 and K[0, 0] != K[1, 1]:
        name, bends = _with_two_focal(name, bends)
    model = CAMERA_MODELS.get(name)
    if model is None or len(bends) != model.num_coefficients or K[0, 1]:
        return None
    focal = K[0, :1] if model.num_focal == 1 else K[[0, 1], [0, 1]]
    params = (*focal.tolist(), float(K[0, 2]) + 0.5, float(K[1, 2]) + 0.5, *bends)
    return ColmapCamera(name, image_size, params)


_WITH_TWO_FOCAL = {
    "SIMPLE_RADIAL": ("OPENCV", 4),
    "RADIAL": ("OPENCV", 4),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", 4),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", 4),
    "SIMPLE_DIVISION": ("DIVISION", 1),
    "SIMPLE_FISHEYE": ("FISHEYE", 0),
}
"""The same lens with a focal length for each axis: its name, and how many numbers it has."""


def _with_two_focal(name: str, bends: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    wider, count = _WITH_TWO_FOCAL[name]
    return wider, (*bends, *(0.0,) * (count - len(bends)))
