"""Faults planted in captures, each with the cause that `deltas check` is to name."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.frame import Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.rotations import quaternions_of, rotations_of
from deltas_nets.check.finding import Fault
from deltas_nets.check.rewrite import of_shape, of_size, swapped, with_focal

Plant = Callable[[Capture], Capture]
FLIP = np.diag([1.0, -1, -1, 1])
ROS = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # x ahead, z up
UNITY = np.diag([1.0, -1, 1, 1])
KINECT = 585 / 525


def poses(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    def plant(capture: Capture) -> Capture:
        frames = capture.frames
        arrays = frames.arrays._replace(cam_from_world=change(frames.cam_from_world.copy()))
        return replace(capture, frames=Frames(frames.folder, arrays))

    return plant


def frames(change: Callable[[int, Frame], Frame]) -> Plant:
    def plant(capture: Capture) -> Capture:
        changed = [change(*item) for item in enumerate(capture.frames.values())]
        return replace(capture, frames=Frames.of(changed, capture.frames.folder))

    return plant


def intrinsics(change: Callable[[np.ndarray], np.ndarray], every: int = 1) -> Plant:
    return frames(lambda i, frame: frame if i % every else replace(frame, K=change(frame.K)))


def scaled(pose: np.ndarray, factor: float) -> np.ndarray:
    pose[:, :3, 3] *= factor
    return pose


def _moved(pose: np.ndarray) -> np.ndarray:
    """One pose in ten, 30 cm away."""
    random = np.random.default_rng(0)
    for frame in random.choice(len(pose), max(1, len(pose) // 10), replace=False):
        pose[frame, :3, 3] += 0.3 * (way := random.normal(size=3)) / np.linalg.norm(way)
    return pose


def shaken(pose: np.ndarray) -> np.ndarray:
    """Each turned by 0.6 degrees or so, about axes of its own."""
    random = np.random.default_rng(0)
    halves = random.normal(0, 0.003, (len(pose), 3))
    turns = rotations_of(np.concatenate([np.ones((len(pose), 1)), halves], axis=-1))
    pose[:, :3] = turns @ pose[:, :3]
    return pose


def _rotations_inverted(pose: np.ndarray) -> np.ndarray:
    """Centres stay where they are."""
    world_from_cam = np.linalg.inv(pose)
    world_from_cam[:, :3, :3] = world_from_cam[:, :3, :3].transpose(0, 2, 1)
    return np.linalg.inv(world_from_cam)


def w_last(pose: np.ndarray) -> np.ndarray:
    """Quaternions written x, y, z, w and read w, x, y, z, as a hand-made images.txt has them."""
    quaternions = quaternions_of(pose[:, :3, :3])
    pose[:, :3, :3] = rotations_of(np.roll(quaternions, -1, axis=-1))
    return pose


def _centre_at(x: float, y: float) -> Plant:
    def change(K: np.ndarray) -> np.ndarray:
        K = K.copy()
        K[:2, 2] = x, y
        return K

    return intrinsics(change)


def moved_down(K: np.ndarray) -> np.ndarray:
    """A principal point as far from the middle as in cameras that there are: 5 % of the height."""
    K = K.copy()
    K[1, 2] *= 0.95
    return K


def in_parts(_: int, frame: Frame) -> Frame:
    """K divided by the sides of its image."""
    height, width = frame.image_size
    return replace(frame, K=np.diag([1 / width, 1 / height, 1]) @ frame.K)


def _still(pose: np.ndarray) -> np.ndarray:
    centre = -pose[0, :3, :3].T @ pose[0, :3, 3]
    pose[:, :3, 3] = -pose[:, :3, :3] @ centre
    return pose


def _copied(capture: Capture) -> Capture:
    some = list(capture.frames.values())
    middle = len(some) // 2
    image = some[middle - 1].image_path
    return frames(lambda i, f: replace(f, image_path=image) if i == middle else f)(capture)


def _long(K: np.ndarray) -> np.ndarray:
    return with_focal(K, 36 * 2 * K[0, 2] / K[0, 0])


def before_a_turn(_: int, frame: Frame) -> Frame:
    """The camera of an image before it was turned by 90 degrees counterclockwise."""
    height, _width = frame.image_size
    K, turn = np.eye(3), np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    K[0, 0], K[1, 1] = frame.K[1, 1], frame.K[0, 0]
    K[:2, 2] = height - 1 - frame.K[1, 2], frame.K[0, 2]
    return replace(frame, K=K, cam_from_world=turn @ frame.cam_from_world)


def pose_before_a_turn(i: int, frame: Frame) -> Frame:
    return replace(before_a_turn(i, frame), K=frame.K)


MATCHES: dict[str, tuple[Plant, Fault]] = {
    "inverted": (poses(np.linalg.inv), Fault.POSES_INVERTED),
    "OpenGL": (poses(lambda pose: FLIP @ pose), Fault.OPENGL_AXES),
    "OpenGL, inverted": (poses(lambda pose: np.linalg.inv(FLIP @ pose)), Fault.POSES_INVERTED),
    "ROS": (poses(lambda pose: ROS @ pose), Fault.OTHER_AXES),
    "Unity": (poses(lambda pose: UNITY @ pose @ UNITY), Fault.OTHER_AXES),
    "millimetres": (poses(lambda pose: scaled(pose, 1000)), Fault.NOT_METRES),
    "another scale": (poses(lambda pose: scaled(pose, 1.3)), Fault.WRONG_SCALE),
    "K of half the size": (intrinsics(lambda K: of_size(K, 0.5)), Fault.K_OF_OTHER_SIZE),
    "K times 1.2": (intrinsics(lambda K: of_size(K, 1.2)), Fault.K_OF_OTHER_SIZE),
    "K transposed": (intrinsics(lambda K: K.T.copy()), Fault.K_TRANSPOSED),
    "x and y swapped": (intrinsics(swapped), Fault.SIDES_SWAPPED),
    "one K in three": (intrinsics(lambda K: of_size(K, 1.1), every=3), Fault.K_OF_SOME_FRAMES),
    "five frames late": (poses(lambda pose: np.roll(pose, 5, 0)), Fault.POSES_OF_OTHER_FRAMES),
    "rotations inverted": (poses(_rotations_inverted), Fault.ROTATIONS_INVERTED),
    "quaternions w last": (poses(w_last), Fault.QUATERNION_ORDER),
    "K of a quarter the size": (intrinsics(lambda K: of_size(K, 0.25)), Fault.K_OF_OTHER_SIZE),
    "depth of 1/5000 m": (
        frames(lambda _, frame: replace(frame, depth_scale=frame.depth_scale / 5)),
        Fault.DEPTH_SCALE,
    ),
    "one pose in ten": (poses(_moved), Fault.FRAMES_DISAGREE),
    "turned images": (frames(before_a_turn), Fault.IMAGES_TURNED),
    "turned images and K": (frames(pose_before_a_turn), Fault.IMAGES_TURNED_BESIDE_POSES),
}
"""Faults that matches tell."""

CAMERAS: dict[str, tuple[Plant, Fault]] = {
    "millimetres": MATCHES["millimetres"],
    "K transposed": MATCHES["K transposed"],
    "K of half the size": MATCHES["K of half the size"],
    "K of 3.56 times the size": (
        intrinsics(lambda K: of_size(moved_down(K), 1920 / 540)),
        Fault.K_OF_OTHER_SIZE,
    ),
    "K in parts of the image": (frames(in_parts), Fault.NONSENSE_CALIBRATION),
    "centre at 0": (_centre_at(0, 0), Fault.NONSENSE_CALIBRATION),
    "centre at -0.5": (_centre_at(-0.5, -0.5), Fault.NONSENSE_CALIBRATION),
    "centre in parts of the image": (_centre_at(0.5, 0.47), Fault.NONSENSE_CALIBRATION),
    "focal length in mm": (
        intrinsics(lambda K: with_focal(K, 4.2 / K[0, 0])),
        Fault.NONSENSE_CALIBRATION,
    ),
    "standing still": (poses(_still), Fault.NO_BASELINE),
    "36 times the width": (intrinsics(_long), Fault.NONSENSE_CALIBRATION),
    "k1 of 1.5": (
        frames(lambda _, frame: replace(frame, lens=Lens("SIMPLE_RADIAL", (1.5,)))),
        Fault.NONSENSE_LENS,
    ),
    "duplicate": (_copied, Fault.DUPLICATE_FRAMES),
    "frozen": (poses(lambda pose: pose[np.arange(len(pose)) // 3 * 3]), Fault.FROZEN_POSES),
}
"""Faults that files and cameras tell alone."""


def with_depth_of_a_kinect(capture: Capture, folder: Path) -> Capture:
    """Depth as a camera with a longer lens sees it."""

    def change(_: int, frame: Frame) -> Frame:
        depth = frame.read_depth()
        K = of_shape(frame.K, frame.image_size, depth.shape)
        row, column = np.mgrid[: depth.shape[0], : depth.shape[1]]
        x = np.round((column - K[0, 2]) / KINECT + K[0, 2]).astype(int)
        y = np.round((row - K[1, 2]) / KINECT + K[1, 2]).astype(int)
        path = folder / f"{frame.id}.png"
        Image.fromarray((1000 * depth[y, x]).round().astype(np.uint16)).save(path)
        return replace(frame, depth_path=path)

    return frames(change)(capture)
