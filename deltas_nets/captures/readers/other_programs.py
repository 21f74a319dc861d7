"""What other programs and data sets write that is no capture yet: how it is known, where to go."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

__all__ = [
    "COLMAP",
    "LAYOUTS",
    "MAIN_FILES",
    "MODELS",
    "OWN",
    "RECORDINGS",
    "TEXTS",
    "Layout",
    "Rule",
]

COLMAP = (
    "colmap automatic_reconstructor --dense 0 --workspace_path {folder} --image_path {images} "
    "finds the poses; then name {folder}"
)
OWN = "write frames.json, as docs/captures.md shows"

Rule = tuple[str, Callable[[Path, bytes], bool], str]
"""What it is called, how it is known by name and first bytes, and the way to go."""


class Layout(NamedTuple):
    """A folder that is known by what is in it.

    Attributes:
        called: its name.
        holds: patterns, each of which finds something there.
        remedy: the way to go.
    """

    called: str
    holds: tuple[str, ...]
    remedy: str


def _by_suffix(*suffixes: str) -> Callable[[Path, bytes], bool]:
    return lambda path, head: path.suffix.lower() in suffixes


MODELS: tuple[Rule, ...] = (
    (
        "a VisualSFM model",
        lambda path, head: path.suffix.lower() == ".nvm" or head.startswith(b"NVM_V"),
        "it has no principal points and one distortion of its own: run COLMAP on its photos, "
        + COLMAP,
    ),
    (
        "a Meshroom scene",
        _by_suffix(".mg", ".sfm", ".baf", ".abc"),
        "export it as COLMAP (aliceVision_exportColmap), or run COLMAP on its photos: " + COLMAP,
    ),
    (
        "a Metashape project",
        lambda path, head: (
            path.suffix.lower() in (".psx", ".psz")
            or (path.suffix.lower() == ".xml" and b"<document" in head and b"<chunk" in head)
        ),
        "in Metashape choose File > Export > Export Cameras > COLMAP, and name what it writes",
    ),
    (
        "a RealityCapture export",
        lambda path, head: (
            path.suffix.lower() in (".rcproj", ".rsproj")
            or (
                path.suffix.lower() == ".csv"
                and any(
                    line.startswith((b"#name,", b"name,x,y"))
                    for line in head.lower().splitlines()[:3]
                )
            )
            or (path.suffix.lower() == ".xmp" and b"capturingreality" in head)
        ),
        "in RealityCapture export the registration as COLMAP text, and name the folder it writes",
    ),
    (
        "a binary scene of OpenMVG",
        lambda path, head: path.name.startswith("sfm_data") and path.suffix == ".bin",
        "write it as text: openMVG_main_ConvertSfM_DataFormat -i sfm_data.bin -o sfm_data.json",
    ),
    (
        "a Bundler model",
        lambda path, head: path.suffix.lower() == ".out" and head.startswith(b"# Bundle file"),
        "it has no principal points and no sizes: run COLMAP on its photos, " + COLMAP,
    ),
    (
        "a Pix4D project",
        lambda path, head: (
            path.suffix.lower() == ".p4d"
            or path.name.endswith("calibrated_external_camera_parameters.txt")
        ),
        "run COLMAP on its photos, " + COLMAP,
    ),
    (
        "a block of ContextCapture (BlocksExchange)",
        lambda path, head: path.suffix.lower() == ".xml" and b"<BlocksExchange" in head,
        f"{OWN}, from its Rotation, Center and CameraDistortion, or run COLMAP on its photos: "
        + COLMAP,
    ),
)

LAYOUTS: tuple[Layout, ...] = (
    Layout(
        "a sequence of EuRoC's",
        ("mav0",),
        f"{OWN}: camera-to-world is the body's pose times T_BS of the camera's sensor.yaml",
    ),
    Layout(
        "a sequence of KITTI's odometry",
        ("calib.txt", "times.txt", "image_[0-3]"),
        f"{OWN}: a line of poses is camera 0 to world, P2 of calib.txt has the K of image_2",
    ),
    Layout(
        "a sequence of Replica as NICE-SLAM has it",
        ("traj.txt", "results"),
        f"{OWN}: a line of traj.txt is camera-to-world, cam_params.json has the K",
    ),
    Layout(
        "a scene of NeuS",
        ("cameras*.npz",),
        f"{OWN}: world_mat times scale_mat is K [R|t] (cv2.decomposeProjectionMatrix)",
    ),
    Layout(
        "a scene of SDFStudio",
        ("meta_data.json",),
        f"{OWN}: camtoworld of meta_data.json is its world_from_cam, intrinsics its K",
    ),
    Layout(
        "a scene of NSVF",
        ("rgb", "pose", "bbox.txt"),
        f"{OWN}: a file of pose is camera-to-world, intrinsics.txt has the K",
    ),
    Layout(
        "a scene of NeRF++",
        ("rgb", "pose", "intrinsics"),
        f"{OWN}: a file of pose is camera-to-world, a file of intrinsics the K",
    ),
    Layout(
        "an export of RTAB-Map's",
        ("*_rgb", "*_calib", "*poses*.txt"),
        f"{OWN}: poses of the camera (not of the robot's base) are camera-to-world, a file of the "
        "folder calib has the K",
    ),
    Layout(
        "an unpacked recording of Record3D",
        ("metadata", "rgbd"),
        "in Record3D export it as EXR and JPEG sequence, and name the folder it writes",
    ),
    Layout(
        "a folder of MicMac's",
        ("Ori-*",),
        "run COLMAP on its photos, " + COLMAP,
    ),
    Layout(
        "DTU as MVSNet trains on it",
        ("Cameras", "Rectified"),
        "make a folder of a scan: Cameras as cams, its images as images/00000000.png, ...",
    ),
    Layout(
        "a recording of Stray Scanner",
        ("odometry.csv", "camera_matrix.csv"),
        f"make images of rgb.mp4 (ffmpeg -i rgb.mp4 images/%06d.jpg) and {OWN}: a row of "
        "odometry.csv is camera-to-world, camera_matrix.csv the K",
    ),
    Layout(
        "a folder that deltas depth filled",
        ("summary.json", "depth"),
        "name the capture that the maps were made of",
    ),
    Layout(
        "TUM RGB-D with its lists joined",
        ("assoc*.txt", "rgb"),
        "write the two lists again: rgb.txt and depth.txt with a stamp and a file a line",
    ),
    Layout(
        "a database of COLMAP's, without a model",
        ("database.db",),
        "colmap mapper --database_path {folder}/database.db --image_path {images} --output_path "
        "{folder}/sparse estimates the poses (make the folder sparse first)",
    ),
)
"""Of several that fit, the first is named."""

RECORDINGS: tuple[Rule, ...] = (
    (
        "a Record3D recording",
        _by_suffix(".r3d"),
        "in Record3D export it as EXR and JPEG sequence, and name the folder it writes",
    ),
    (
        "a video",
        _by_suffix(".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mts", ".360", ".insv"),
        "make photos of it (ffmpeg -i VIDEO -r 3 -q:v 2 {folder}/images/%05d.jpg, in a new folder "
        "images) and run COLMAP: " + COLMAP.replace("{images}", "{folder}/images"),
    ),
    (
        "an archive",
        _by_suffix(".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar"),
        "unpack it, and name the folder",
    ),
    (
        "a recording of ROS",
        _by_suffix(".bag", ".db3", ".mcap"),
        f"save images of it and their poses, and {OWN}",
    ),
    (
        "a recording of a ZED or RealSense camera",
        _by_suffix(".svo", ".svo2"),
        f"save images of it and the tracked poses with the maker's tools, and {OWN}",
    ),
    (
        "a mesh, a scan or splats",
        _by_suffix(
            ".ply", ".obj", ".glb", ".gltf", ".usdz", ".stl", ".fbx", ".las", ".laz", ".e57",
            ".splat", ".ksplat", ".spz",
        ),
        "name the folder of the photos that it was made of, with their poses",
    ),
    (
        "a photo",
        _by_suffix(".jpg", ".jpeg", ".png", ".heic", ".heif", ".tif", ".tiff", ".dng", ".webp"),
        "name the folder with all photos and their poses; depth needs two at least",
    ),
)  # fmt: skip
"""What is no capture only where nothing else is there."""

MAIN_FILES = (
    "frames.json", "frames.csv", "transforms.json", "reconstruction.json", "sfm_data.json",
    "poses_bounds.npy", "groundtruth.txt",
)  # fmt: skip
"""By which captures are known; one of nearly that name may be meant to be it."""

TEXTS = (".nvm", ".xml", ".csv", ".out", ".xmp")
"""Suffixes of files that only their first bytes tell apart."""
