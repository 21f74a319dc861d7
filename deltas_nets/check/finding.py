"""What can be wrong with a capture, and one thing that is."""

from collections.abc import Callable
from enum import Enum
from typing import Any, Literal, NamedTuple

from deltas_nets.captures.capture import Capture

__all__ = ["Fault", "Finding", "Mend"]

Mend = Callable[[Capture], Capture]
"""A capture without the fault."""


class Fault(Enum):
    """What is wrong; the value is a sentence."""

    REFUSED = "the capture cannot be read"
    POSES_LOST = "frames have no usable pose"
    IMAGES_MISSING = "frames have no image"
    IMAGES_UNREADABLE = "images cannot be used"
    DUPLICATE_FRAMES = "one image stands for several frames"
    FROZEN_POSES = "frames share one pose, but not one image"
    BLURRED = "images are blurred"
    FRAMES_UNMATCHED = "frames match none of those around them"
    NO_BASELINE = "the camera does not move: without a baseline there is no depth"
    FEW_MATCHES = "images hardly match: nothing can be told of their cameras"
    NONSENSE_CALIBRATION = "no camera has such intrinsics"
    NONSENSE_LENS = "no lens bends lines like that"
    LENS_TWICE = "a lens is stated, but images are straight already"
    LENS_MISSING = "images bend lines, but no lens is stated"
    K_TRANSPOSED = "K is transposed"
    K_OF_OTHER_SIZE = "K is of images of another size"
    K_OF_SOME_FRAMES = "the K of some frames is of images of another size"
    SIDES_SWAPPED = "width and height are swapped"
    FOCAL_LENGTH = "the focal length is wrong"
    POSES_INVERTED = "poses are inverted: world-to-camera and camera-to-world are mixed up"
    OPENGL_AXES = "poses have OpenGL's axes (y up, z backward)"
    OPENCV_AXES = "poses have OpenCV's axes (y down, z forward), the format has OpenGL's"
    OTHER_AXES = "poses have other axes than x right, y down, z forward"
    OTHER_AXES_THAN_OPENGL = "poses have other axes than x right, y up, z backward"
    IMAGES_TURNED = "images are turned, and their K and poses are not"
    IMAGES_TURNED_BESIDE_POSES = "images are turned, and their poses are not"
    POSES_MIRROR = "poses mirror, as no camera moves"
    POSES_SCALE = "the rotations of poses hold a scale"
    POSES_TRANSPOSED = "poses are transposed"
    ROTATIONS_TRANSPOSED = "rotations are transposed, positions are not"
    ROTATIONS_INVERTED = "rotations are inverted, camera centres are not"
    QUATERNION_ORDER = "the four numbers of quaternions are in another order"
    CENTERS_AS_TRANSLATIONS = "translations and camera centres are mixed up"
    POSES_OF_OTHER_FRAMES = "poses belong to other frames"
    FRAMES_DISAGREE = "the poses of some frames disagree with all others"
    POSES_SHAKE = "poses are each a little off"
    NOT_METRES = "the unit of the poses is not the metre"
    WRONG_SCALE = "poses and sensor depth differ in scale"
    DEPTH_SCALE = "the unit of sensor depth is not the one stated"
    DEPTH_UNREADABLE = "sensor depth cannot be used"
    DEPTH_NOT_REGISTERED = "depth is of another camera than the images"
    HALF_A_PIXEL = "K and the images differ by half a pixel"
    UNEXPLAINED = "poses and images do not agree, and no single cause explains it"


class Finding(NamedTuple):
    """One thing that is wrong.

    Attributes:
        cause: what.
        evidence: a sentence with the figures that show it.
        frames: ids of those concerned; empty = all.
        cure: what to do, exactly.
        severity: "error" where depth would be wrong, "warning" where some of it would be.
        mend: the cure, done to a capture in memory; None where nothing in memory can be mended.
    """

    cause: Fault
    evidence: str
    frames: tuple[str, ...]
    cure: str
    severity: Literal["error", "warning"] = "error"
    mend: Mend | None = None

    def in_json(self) -> dict[str, Any]:
        """The same fields, for files."""
        return {
            "cause": self.cause.name.lower(),
            "sentence": self.cause.value,
            "evidence": self.evidence,
            "frames": list(self.frames),
            "cure": self.cure,
            "severity": self.severity,
        }
