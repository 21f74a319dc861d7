"""What can be wrong with cameras and matches, and the cure of each."""

from enum import Enum


class Cause(Enum):
    """Why matches do not fit the cameras, or that they do; the value is a sentence.

    Of several that explain a capture equally well, an earlier one is named first.
    """

    ALL_WELL = "cameras and matches agree"
    TOO_FEW_MATCHES = "no two views have 8 matches: nothing can be told"
    PIXELS_NORMALIZED = "pixels are normalised, next to (0, 0)"
    NO_BASELINE = "without a baseline there is no depth"
    POSES_INVERTED = "poses are camera-to-world in the place of world-to-camera"
    OPENGL_WORLD_FROM_CAM = "poses are camera-to-world with OpenGL's axes (y up, z backward)"
    OPENGL_AXES = "poses have OpenGL's axes (y up, z backward)"
    ROTATIONS_TRANSPOSED = "rotations are transposed, translations are not"
    ROTATIONS_INVERTED = "rotations are inverted, camera centres are not"
    CENTERS_AS_TRANSLATIONS = "translations are the camera centres: t should be -R C"
    K_TRANSPOSED = "K is transposed"
    K_OF_OTHER_SIZE = "K is of images of another size"
    FOCAL_LENGTH = "focal lengths are those of another lens or zoom"
    HALF_A_PIXEL = "pixels and K differ by half a pixel: centres at 0.5 met centres at 0"
    CROPPED = "pixels are of images cropped since K, or its centre is shifted"
    AXES_SWAPPED = "pixels are (row, column) in the place of (x, y)"
    VIEWS_SWAPPED = "the pixels of two views are exchanged"
    POINTS_AS_VIEWS = "pixels are (N, V, 2) in the place of (V, N, 2)"
    UNIT_OF_TRANSLATION = "the translation of one camera has another unit"
    CAMERA_DISAGREES = "one camera disagrees with all others"
    NO_SINGLE_CAUSE = "no single cause explains it"


CURES: dict[Cause, str] = {
    Cause.ALL_WELL: "nothing to do",
    Cause.TOO_FEW_MATCHES: "give more matches, or views that overlap",
    Cause.PIXELS_NORMALIZED: "multiply by K (cv2.undistortPoints: P=K), or by the image's size",
    Cause.NO_BASELINE: "take pictures from other places, or find the lost translations",
    Cause.POSES_INVERTED: "PosedViews.from_world_from_cam(K, poses)",
    Cause.OPENGL_WORLD_FROM_CAM: "PosedViews.from_opengl(K, poses)",
    Cause.OPENGL_AXES: "PosedViews.from_opengl(K, invert_pose(poses))",
    Cause.ROTATIONS_TRANSPOSED: "poses[..., :3, :3] = poses[..., :3, :3].mT.clone()",
    Cause.ROTATIONS_INVERTED: (
        "PosedViews.from_world_from_cam(K, poses), poses[..., :3, :3] being as they are and "
        "poses[..., :3, 3:] the camera centres"
    ),
    Cause.CENTERS_AS_TRANSLATIONS: (
        "poses[..., :3, 3:] = -poses[..., :3, :3] @ poses[..., :3, 3:]"
    ),
    Cause.K_TRANSPOSED: "PosedViews(K.mT, poses)",
    Cause.K_OF_OTHER_SIZE: "views.resize(old_size=size_of_K, new_size=size_of_images)",
    Cause.FOCAL_LENGTH: "multiply K[..., :2, :2] by the factor",
    Cause.HALF_A_PIXEL: "add the shift to pixels, or take it from the centres in K",
    Cause.CROPPED: "views.crop(left=left, top=top)",
    Cause.AXES_SWAPPED: "pixels.flip(-1)",
    Cause.VIEWS_SWAPPED: "exchange the pixels, or the cameras, of the two views",
    Cause.POINTS_AS_VIEWS: "pixels.transpose(0, 1)",
    Cause.UNIT_OF_TRANSLATION: "multiply its translation by the factor",
    Cause.CAMERA_DISAGREES: "leave it out, mask[camera] = False, or find its pose anew",
    Cause.NO_SINGLE_CAUSE: (
        "look at residuals camera by camera; poses may drift, lenses be distorted, or most matches "
        "be wrong"
    ),
}
"""What to do about each."""
