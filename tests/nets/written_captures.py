"""One small scene in the layouts of other programs, written by hand from their descriptions."""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

SIZE = 48, 64
F, CX, CY = 60.0, 31.2, 23.9
K = np.array([[F, 0, CX], [0, F, CY], [0, 0, 1]])
SKEWED = np.array([[F, 0.75, CX], [0, F, CY], [0, 0, 1]])
"""Of formats that state a matrix."""
OPENGL = np.diag([1.0, -1, -1, 1])
NUM = 4


class Scene(NamedTuple):
    world_from_cam: np.ndarray
    images: list[np.ndarray]
    depths: list[np.ndarray]

    @property
    def cam_from_world(self) -> np.ndarray:
        return np.linalg.inv(self.world_from_cam)


class Written(NamedTuple):
    """What a writer made: what to open, ids in the scene's order, and what is to be read."""

    path: Path
    ids: list[str]
    lens: tuple[str, tuple[float, ...]] | None = None
    depth: bool = False
    metric: bool = True
    doubts: int = 0
    K: np.ndarray = K


def make_scene() -> Scene:
    rng = np.random.default_rng(7)
    poses = np.tile(np.eye(4), (NUM, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.7, (NUM, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 2, (NUM, 3))
    images = list(rng.integers(0, 255, (NUM, *SIZE, 3), dtype=np.uint8))
    depths = [np.round(rng.uniform(0.5, 6, SIZE), 3) for _ in range(NUM)]
    for depth in depths:
        depth[:5] = 0
    return Scene(poses, images, depths)


def write_image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)


def write_steps(path: Path, depth: np.ndarray, scale: float = 1000) -> None:
    write_image(path, np.round(depth * scale).astype(np.uint16))


def exr(depth: np.ndarray, compression: int = 3, top: int = 0) -> bytes:
    """One channel of half floats, as openexr.com/en/latest/OpenEXRFileLayout.html has it."""
    height, width = depth.shape

    def attribute(name: str, type: str, value: bytes) -> bytes:
        return f"{name}\0{type}\0".encode() + struct.pack("<I", len(value)) + value

    window = struct.pack("<4i", 0, top, width - 1, top + height - 1)
    head = b"\x76\x2f\x31\x01" + struct.pack("<I", 2)
    head += attribute("channels", "chlist", b"Z\0" + struct.pack("<iIii", 1, 0, 1, 1) + b"\0")
    head += attribute("compression", "compression", bytes([compression]))
    head += attribute("dataWindow", "box2i", window) + b"\0"
    lines, chunks = 16 if compression == 3 else 1, []
    for first in range(0, height, lines):
        plain = depth[first : first + lines].astype("<f2").tobytes()
        halves = np.frombuffer(plain[0::2] + plain[1::2], np.uint8).astype(int)
        steps = np.diff(halves, prepend=halves[0]) + 128
        steps[0] = halves[0]
        shuffled = (steps % 256).astype(np.uint8).tobytes()
        packed = zlib.compress(shuffled)
        if compression == 1:
            packed = b"".join(struct.pack("bB", 0, byte) for byte in shuffled)
        kept = packed if compression and len(packed) < len(plain) else plain
        chunks.append(struct.pack("<iI", top + first, len(kept)) + kept)
    places = len(head) + 8 * len(chunks) + np.cumsum([0, *map(len, chunks[:-1])])
    return head + places.astype("<u8").tobytes() + b"".join(chunks)


def write_text(path: Path, *rows: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [row if isinstance(row, str) else " ".join(f"{x:.12g}" for x in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")


def _json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def _xyzw(rotation: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(rotation).as_quat()


def tum(folder: Path, scene: Scene) -> Written:
    """Poses 20 ms before and after each image, which is 40 % of the way; depth 5 ms late."""
    names = [f"{100 + i / 5:.6f}" for i in range(NUM)]
    poses = ["# timestamp tx ty tz qx qy qz qw"]
    for i, pose in enumerate(scene.world_from_cam):
        turn = Rotation.from_matrix(pose[:3, :3])
        spin, step = Rotation.from_rotvec([0.1, 0.2, 0]), np.array([0.1, 0, 0.2])
        # At 40 % of the arc and of the way stands the camera.
        for part in (-0.4, 0.6):
            q = (turn * Rotation.from_rotvec(part * spin.as_rotvec())).as_quat()
            q = -q if part > 0 else q
            t = 100 + i / 5 + 0.05 * part
            numbers = " ".join(f"{x:.12g}" for x in (*(pose[:3, 3] + part * step), *q))
            poses.append(f"{t:.6f} {numbers}")
        write_image(folder / "rgb" / f"{names[i]}.png", scene.images[i])
        late = f"{100 + i / 5 + 0.005:.6f}"
        write_steps(folder / "depth" / f"{late}.png", scene.depths[i], 5000)
    late = [f"{float(name) + 0.005:.6f}" for name in names]
    write_text(folder / "rgb.txt", "# list", *(f"{n} rgb/{n}.png" for n in [*names, "500.0"]))
    write_text(folder / "depth.txt", *(f"{n} depth/{n}.png" for n in late))
    write_text(folder / "groundtruth.txt", *poses)
    write_text(folder / "intrinsics.txt", (F, F, CX, CY, 0.1, -0.2, 0.01, 0.02, 0.3))
    lens = "FULL_OPENCV", (0.1, -0.2, 0.01, 0.02, 0.3, 0.0, 0.0, 0.0)
    return Written(folder, names, lens, True, doubts=1)


def record3d(folder: Path, scene: Scene) -> Written:
    poses = [[*_xyzw((pose @ OPENGL)[:3, :3]), *pose[:3, 3]] for pose in scene.world_from_cam]
    by_column = [F, 0, 0, 0, F, 0, CX + 0.5, CY + 0.5, 1]
    content = {"w": 64, "h": 48, "K": by_column, "poses": poses, "dw": 32, "dh": 24, "fps": 60}
    _json(folder / "EXR_RGBD" / "metadata.json", content)
    for i in range(NUM):
        write_image(folder / "EXR_RGBD" / "rgb" / f"{i}.jpg", scene.images[i])
        (folder / "EXR_RGBD" / "depth").mkdir(exist_ok=True)
        (folder / "EXR_RGBD" / "depth" / f"{i}.exr").write_bytes(exr(scene.depths[i]))
    return Written(folder, [str(i) for i in range(NUM)], None, True)


def polycam(folder: Path, scene: Scene) -> Written:
    for i, pose in enumerate(scene.world_from_cam @ OPENGL):
        camera = {f"t_{r}{c}": pose[r, c] for r in range(3) for c in range(4)}
        camera |= {"fx": 2 * F, "fy": 2 * F, "cx": 2 * (CX + 0.5), "cy": 2 * (CY + 0.5)}
        keyframes = folder / "keyframes"
        # Stated for twice the size.
        _json(keyframes / f"corrected_cameras/{7 + i}.json", camera | {"width": 128, "height": 96})
        write_image(keyframes / "corrected_images" / f"{7 + i}.jpg", scene.images[i])
        write_steps(keyframes / "depth" / f"{7 + i}.png", scene.depths[i])
    return Written(folder, [str(7 + i) for i in range(NUM)], None, True, doubts=1)


def sevenscenes(folder: Path, scene: Scene) -> Written:
    """As 3DMatch does it: one camera, stated, in two sequences."""
    write_text(folder / "camera-intrinsics.txt", *K)
    names = [f"seq-0{1 + i % 2}/frame-{i:06d}" for i in range(NUM)]
    for name, pose, image, depth in zip(names, *scene, strict=True):
        write_image(folder / f"{name}.color.png", image)
        write_steps(folder / f"{name}.depth.png", depth)
        write_text(folder / f"{name}.pose.txt", *pose)
    return Written(folder, names, None, True)


def robustmvd(folder: Path, scene: Scene) -> Written:
    places = [folder / "key", *(folder / "source" / str(i) for i in range(NUM - 1))]
    for place, pose, image in zip(places, scene.cam_from_world, scene.images, strict=True):
        write_image(place / "image.png", image)
        np.save(place / "K.npy", SKEWED.astype(np.float32))
        np.save(place / "to_ref_transform.npy", pose @ scene.world_from_cam[0])
    return Written(folder, ["key", *(str(i) for i in range(NUM - 1))], K=SKEWED)


def opensfm(folder: Path, scene: Scene) -> Written:
    camera = {"projection_type": "brown", "width": 64, "height": 48, "focal_x": F / 64}
    camera |= {"focal_y": F / 64, "c_x": (CX + 0.5 - 32) / 64, "c_y": (CY + 0.5 - 24) / 64}
    camera |= {"k1": 0.1, "k2": 0.2, "p1": 0.01, "p2": 0.02, "k3": 0.3}
    shots = {}
    for i, pose in enumerate(scene.cam_from_world):
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()
        shots[f"{i}.jpg"] = {"rotation": turn, "translation": pose[:3, 3].tolist(), "camera": "a"}
        write_image(folder / "images" / f"{i}.jpg", scene.images[i])
    points = {"5": {"coordinates": [1, 2, 3], "color": [9, 8, 7]}}
    content = {"cameras": {"a": camera}, "shots": shots, "points": points}
    _json(folder / "reconstruction.json", [{**content, "shots": {}}, content])
    write_text(
        folder / "tracks.csv", "OPENSFM_TRACKS_VERSION_v2", "0.jpg\t5\t0\t0.25\t-0.125\t1\t1\t1"
    )
    lens = "FULL_OPENCV", (0.1, 0.2, 0.01, 0.02, 0.3, 0.0, 0.0, 0.0)
    return Written(folder, [str(i) for i in range(NUM)], lens, metric=False, doubts=1)


def openmvg(folder: Path, scene: Scene) -> Written:
    def pair(key: int, **value: Any) -> dict[str, Any]:
        return {"key": key, "value": value}

    def data(**fields: Any) -> dict[str, Any]:
        return {"id": 1, "data": fields}

    views, poses = [], []
    for i, pose in enumerate(scene.world_from_cam):
        size = {"width": 64, "height": 48, "id_intrinsic": 5, "id_pose": i, "id_view": i}
        value = data(local_path="", filename=f"a {i}.jpg", **size)
        views.append(pair(i, polymorphic_id=2**30, ptr_wrapper=value))
        poses.append(pair(i, rotation=pose[:3, :3].T.tolist(), center=pose[:3, 3].tolist()))
        write_image(folder / "photos" / f"a {i}.jpg", scene.images[i])
    lens = {"disto_t2": [0.1, 0.2, 0.3, 0.01, 0.02]}
    camera = data(width=64, height=48, focal_length=F, principal_point=[CX, CY], **lens)
    kind = {"polymorphic_id": 2**31 + 1, "polymorphic_name": "pinhole_brown_t2"}
    seen = [pair(0, id_feat=0, x=[47.5, 15.5])]
    content = {
        "sfm_data_version": "0.3",
        "root_path": "/elsewhere/photos",
        "views": views,
        "intrinsics": [pair(5, **kind, ptr_wrapper=camera)],
        "extrinsics": poses,
        "structure": [pair(0, X=[1, 2, 3], observations=seen)],
        "control_points": [],
    }
    _json(folder / "out" / "reconstruction" / "sfm_data.json", content)
    lens_read = "FULL_OPENCV", (0.1, 0.2, 0.01, 0.02, 0.3, 0.0, 0.0, 0.0)
    return Written(folder, [f"a {i}" for i in range(NUM)], lens_read, metric=False)


def kapture(folder: Path, scene: Scene) -> Written:
    """Two cameras on a rig, one of them turned."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0.5, 0]).as_matrix()
    turn[:3, 3] = 0.1, 0.2, 0.3

    def row(*words: Any, pose: np.ndarray) -> str:
        q = _xyzw(pose[:3, :3])
        numbers = (*q[[3, 0, 1, 2]], *pose[:3, 3])
        return ", ".join([*map(str, words), *(f"{x:.12g}" for x in numbers)])

    camera = f"camera, OPENCV, 64, 48, {F}, {F}, {CX + 0.5}, {CY + 0.5}, .1, .2, .01, .02"
    head = "# kapture format: 1.1"
    sensors = folder / "sensors"
    write_text(sensors / "sensors.txt", head, f"left, , {camera}", f"right, x, {camera}")
    rigs = [row("rig", "left", pose=np.eye(4)), row("rig", "right", pose=turn)]
    write_text(sensors / "rigs.txt", head, *rigs)
    records, poses = [], []
    for i, pose in enumerate(scene.cam_from_world):
        device = ("left", "right")[i % 2]
        rig = pose if i % 2 == 0 else np.linalg.inv(turn) @ pose
        records.append(f"{i}, {device}, {device}/{i}.jpg")
        poses.append(row(i, "rig", pose=rig) if i < 2 else row(i, device, pose=pose))
        write_image(sensors / "records_data" / device / f"{i}.jpg", scene.images[i])
    write_text(sensors / "records_camera.txt", head, *records)
    write_text(sensors / "trajectories.txt", head, *poses)
    write_text(folder / "reconstruction" / "points3d.txt", head, "1, 2, 3, 9, 8, 7")
    ids = [f"{('left', 'right')[i % 2]}/{i}" for i in range(NUM)]
    return Written(folder, ids, ("OPENCV", (0.1, 0.2, 0.01, 0.02)), metric=False)


def mvsnet(folder: Path, scene: Scene) -> Written:
    moved = np.array([[F, 0.75, CX + 0.5], [0, F, CY + 0.5], [0, 0, 1]])
    for i, pose in enumerate(scene.cam_from_world):
        rows = "extrinsic", *pose, "", "intrinsic", *moved, "", "0.5 0.1 51 5.5"
        write_text(folder / "cams" / f"{i:08d}_cam.txt", *rows)
        write_image(folder / "images" / f"{i:08d}.jpg", scene.images[i])
        write_image(folder / "depths" / f"{i:08d}.pfm", scene.depths[i].astype(np.float32))
    pairs = [
        line for i in range(NUM) for line in (str(i), f"2 {(i + 2) % NUM} 9.5 {(i + 1) % NUM} 3")
    ]
    write_text(folder / "pair.txt", str(NUM), *pairs)
    return Written(folder, [f"{i:08d}" for i in range(NUM)], None, True, metric=False, K=SKEWED)


def sens(folder: Path, scene: Scene) -> Written:
    four = np.eye(4)
    four[:3, :3] = SKEWED
    out = struct.pack("<IQ", 4, 6) + b"sensor"
    for matrix in (four, np.eye(4), four, np.eye(4)):
        out += matrix.astype("<f4").tobytes()
    out += struct.pack("<iiIIIIfQ", 2, 1, 64, 48, 64, 48, 1000, NUM)
    for pose, image, depth in zip(*scene, strict=True):
        colour = cv2.imencode(".jpg", image)[1].tobytes()
        steps = zlib.compress(np.round(depth * 1000).astype("<u2").tobytes())
        out += pose.astype("<f4").tobytes() + struct.pack("<QQQQ", 1, 2, len(colour), len(steps))
        out += colour + steps
    folder.mkdir(parents=True)
    (folder / "scene.sens").write_bytes(out)
    return Written(folder / "scene.sens", [str(i) for i in range(NUM)], None, True, K=SKEWED)


def demon(folder: Path, scene: Scene) -> Written:
    write_text(folder / "cam.txt", *K)
    write_text(folder / "poses.txt", *(pose[:3].ravel() for pose in scene.cam_from_world))
    for i in range(NUM):
        write_image(folder / f"{i:04d}.jpg", scene.images[i])
        np.save(folder / f"{i:04d}.npy", scene.depths[i].astype(np.float32))
    return Written(folder, [f"{i:04d}" for i in range(NUM)], None, True)


def strecha(folder: Path, scene: Scene) -> Written:
    for i, pose in enumerate(scene.world_from_cam):
        write_image(folder / "images" / f"{i:04d}.jpg", scene.images[i])
        rows = *SKEWED, "0 0 0", *pose[:3, :3], pose[:3, 3], "64 48"
        write_text(folder / "cameras" / f"{i:04d}.jpg.camera", *rows)
    return Written(folder, [f"{i:04d}" for i in range(NUM)], metric=False, K=SKEWED)


Writer = Callable[[Path, Scene], Written]
WRITERS: dict[str, Writer] = {
    "TUM RGB-D": tum,
    "Record3D EXR": record3d,
    "Polycam": polycam,
    "7-Scenes": sevenscenes,
    "Robust MVD": robustmvd,
    "OpenSfM": opensfm,
    "OpenMVG": openmvg,
    "kapture": kapture,
    "MVSNet": mvsnet,
    ".sens": sens,
    "DeMoN": demon,
    "Strecha": strecha,
}
"""By the layout that the capture says."""
