"""A capture as ScanNet exports it: color/N.jpg, depth/N.png, pose/N.txt, intrinsic/*.txt.

Its frames are numbers, its images of one camera without distortion, its unit is the metre.
"""

from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.depth_files import MILLIMETRES
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.images import in_words
from deltas_nets.captures.readers.scannet import IMAGE_SUFFIXES
from deltas_nets.captures.register import register_depth
from deltas_nets.captures.writers.files import (
    Putting,
    image_name,
    put_depth,
    put_image,
    put_image_as_png,
    write_millimetres,
)
from deltas_nets.errors import UserError

__all__ = ["write"]

TABLE = "ids.txt"
"""Which number stands for which frame, where ids are no numbers."""


def write(capture: Capture, folder: Path, putting: Putting) -> list[str]:
    """Write the folders; see `deltas_nets.captures.writers` for the contract."""
    _check(capture)
    ids = list(capture.frames)
    numbered = all(id.isascii() and id.isdigit() and str(int(id)) == id for id in ids)
    names = ids if numbered else [str(number) for number in range(len(ids))]
    first = capture.frames.at(0)
    _write_matrix(folder / "intrinsic" / "intrinsic_color.txt", first.K)
    of_depth = _one_depth_camera(capture)
    if of_depth is not None:
        _write_matrix(folder / "intrinsic" / "intrinsic_depth.txt", of_depth)
    for name, frame in zip(names, capture.frames.values(), strict=True):
        _put_image(frame, folder / "color" / name, putting)
        _put_depth(frame, folder / "depth" / name, putting, registered=of_depth is None)
        world_from_cam = np.linalg.inv(frame.cam_from_world).astype(np.float64)
        _write_matrix(folder / "pose" / f"{name}.txt", world_from_cam)
    said = []
    if not numbered:
        lines = [f"{name} {id}\n" for name, id in zip(names, ids, strict=True)]
        (folder / TABLE).write_text("".join(lines), encoding="utf-8")
        said.append(f"frames are numbered from 0: {TABLE} has the id of each")
    if capture.points is not None:
        said.append("sparse points are left out: the format has none")
    return said


def _check(capture: Capture) -> None:
    """Refuse what the format cannot say.

    Raises:
        UserError: a lens bends lines, cameras differ, or the unit is not the metre.
    """
    cameras = {(c.K.tobytes(), c.image_size): c for c in capture.frames.arrays.cameras}
    lenses = [c.lens.model for c in capture.frames.arrays.cameras if c.lens is not None]
    if lenses:
        what = f"the images are of a {lenses[0]} lens; ScanNet's export has straight ones only"
        raise UserError(what, capture.path, "use --to own or colmap, or undistort the images")
    if len(cameras) > 1:
        sizes = sorted({in_words(camera.image_size) for camera in cameras.values()})
        what = (
            f"there are {len(cameras)} cameras ({', '.join(sizes[:3])}); ScanNet's export has one"
        )
        raise UserError(what, capture.path, "use --to own, colmap or transforms")
    if not capture.metric:
        what = "the capture does not say how long its unit is; ScanNet's export is in metres"
        raise UserError(what, capture.path, "add --scale METRES, the length of its unit")


def _one_depth_camera(capture: Capture) -> FloatArray | None:
    """``(3, 3)`` of all depth, where it is one camera that stands where the colour camera does."""
    known = capture.frames.arrays.cameras
    moved = any(camera.cam_from_depth is not None for camera in known)
    matrices = {
        camera.depth_K.tobytes(): camera.depth_K for camera in known if camera.depth_K is not None
    }
    return next(iter(matrices.values())) if len(matrices) == 1 and not moved else None


def _put_image(frame: Frame, target: Path, putting: Putting) -> None:
    suffix = Path(image_name(frame)).suffix
    if suffix in IMAGE_SUFFIXES:
        put_image(frame, target.with_name(target.name + suffix), putting)
    else:
        put_image_as_png(frame, target.with_name(f"{target.name}.png"), putting)


def _put_depth(frame: Frame, target: Path, putting: Putting, *, registered: bool) -> None:
    """Depth as PNG in millimetres: as it is where it is that, else written anew."""
    path = frame.depth_path
    if path is None:
        return
    as_it_is = path.suffix.lower() == ".png" and frame.depth_scale == MILLIMETRES
    if registered and (frame.depth_K is not None or frame.cam_from_depth is not None):
        write_millimetres(register_depth(frame), target, frame)
    elif as_it_is:
        put_depth(frame, target, putting)
    else:
        write_millimetres(frame.read_depth(), target, frame)


def _write_matrix(path: Path, matrix: FloatArray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = np.eye(4)
    whole[: len(matrix), : len(matrix)] = matrix
    np.savetxt(path, whole, fmt="%.17g")
