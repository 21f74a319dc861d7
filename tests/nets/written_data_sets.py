"""The scene of `written_captures` as ARKitScenes, LLFF and 3D Scanner App have it."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from written_captures import (
    CX,
    CY,
    NUM,
    OPENGL,
    SKEWED,
    F,
    Scene,
    Writer,
    Written,
    write_image,
    write_steps,
    write_text,
)


def arkitscenes(folder: Path, scene: Scene) -> Written:
    """A scan of the 3D detection part: poses 40 ms before and 60 ms after each image."""
    scan, ids = folder / "4711", [f"{3000 + i / 2:.3f}" for i in range(NUM)]
    frames, lines = scan / "4711_frames", []
    for i, pose in enumerate(scene.world_from_cam):
        turn, step = Rotation.from_rotvec([0.1, 0.2, 0]).as_rotvec(), np.array([0.1, 0, 0.2])
        for part in (-0.4, 0.6):
            turned = Rotation.from_matrix(pose[:3, :3]) * Rotation.from_rotvec(part * turn)
            cam_from_world = turned.inv()
            shift = -cam_from_world.apply(pose[:3, 3] + part * step)
            numbers = (3000 + i / 2 + 0.1 * part, *cam_from_world.as_rotvec(), *shift)
            lines.append(" ".join(f"{x:.12g}" for x in numbers))
        name = f"4711_{ids[i]}"
        write_image(frames / "lowres_wide" / f"{name}.png", scene.images[i])
        # A rounded name, as some of the data set's are.
        write_steps(frames / "lowres_depth" / f"4711_{3000.001 + i / 2:.3f}.png", scene.depths[i])
        camera = (64, 48, F, F, CX + 0.5, CY + 0.5)
        write_text(frames / "lowres_wide_intrinsics" / f"{name}.pincam", camera)
    write_text(frames / "lowres_wide.traj", *lines)
    return Written(scan, ids, None, True)


def llff(folder: Path, scene: Scene) -> Written:
    """Photos half as large as those that the poses are of; the principal point is the middle."""
    rows = []
    for i, pose in enumerate(scene.world_from_cam):
        right, down, forward = pose[:3, :3].T
        camera = 2 * 48, 2 * 64, 2 * F
        matrix = np.stack([down, right, -forward, pose[:3, 3], camera], axis=1)
        rows.append([*matrix.ravel(), 0.5, 5.5])
        write_image(folder / "images" / f"IMG {i}.JPG", scene.images[i])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    middle = np.array([[F, 0, 31.5], [0, F, 23.5], [0, 0, 1]])
    return Written(folder, [f"IMG {i}" for i in range(NUM)], K=middle, metric=False, doubts=1)


def scanner_app(folder: Path, scene: Scene) -> Written:
    """A scan as it is shared: more poses than photos, depth with what is known of it beside."""
    for i, pose in enumerate(scene.world_from_cam @ OPENGL):
        camera = {
            "cameraPoseARFrame": [*pose.ravel()[:15].tolist(), 0.99999994],  # as floats are printed
            "intrinsics": [F, 0.75, CX + 0.5, 0, F, CY + 0.5, 0, 0, 1],
            "projectionMatrix": [1.0] * 16,
            "frame_index": 5 * i,
            "time": 100 + i / 12,
            "motionQuality": 0.9,
        }
        write_image(folder / f"frame_{5 * i:05d}.jpg", scene.images[i])
        write_steps(folder / f"depth_{5 * i:05d}.png", scene.depths[i])
        write_image(folder / f"conf_{5 * i:05d}.png", np.full((24, 32), 2, np.uint8))
        for number in (5 * i, 5 * i + 1):
            (folder / f"frame_{number:05d}.json").write_text(json.dumps(camera))
    write_image(folder / "thumb_00000.jpg", scene.images[0])
    (folder / "info.json").write_text(json.dumps({"title": "Scan"}))
    return Written(folder, [f"frame_{5 * i:05d}" for i in range(NUM)], None, True, K=SKEWED)


DATA_SETS: dict[str, Writer] = {
    "ARKitScenes": arkitscenes,
    "LLFF": llff,
    "3D Scanner App": scanner_app,
}
