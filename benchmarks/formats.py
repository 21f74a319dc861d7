"""Depth of one capture as other programs would have written it, beside depth of it as it is.

    python benchmarks/formats.py CAPTURE VIEW_SETS.json [SETS]

COLMAP, transforms.json, ScanNet's export and our own format come from our writers; TUM RGB-D,
MVSNet and Record3D are written here, by the layouts of their programs. Every format is read again,
in metres by --scale 1 where it does not know them, and searched as `deltas depth` does. Abs Rel is
by the sensor depth of the capture as it is; apart is the median difference of the maps.
"""

import json
import struct
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from shutil import copyfile

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from deltas_nets import open_capture
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.captures.scaled import scaled
from deltas_nets.captures.view_sets import ViewSet, named_frames, read_view_sets
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.evaluate.depth_metrics import depth_metrics
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.predictor import Predictor, load_predictor
from deltas_nets.predict.search import Followed

OURS = ("own", "scannet", "colmap", "colmap-bin", "transforms")
CORNER = 0.5  # from the middle of the first pixel to the corner of the image
OPENGL = np.diag([1.0, -1, -1, 1])
TUM_STEPS, LARGEST = 5000, 65535
PLANES = 192
Depths = list[NDArray[np.float32]]


def main() -> None:
    whole = open_capture(sys.argv[1])
    count = int(sys.argv[3]) if len(sys.argv) > 3 else 10
    sets = read_view_sets(Path(sys.argv[2]), whole)
    sets = sets[:: max(1, len(sets) // count)][:count]
    sets = tuple(views._replace(sources=views.sources[:2]) for views in sets)
    capture = only(whole, sets)
    network = load_predictor("deltas-small")
    truth = [depth_at_image(capture.frame(views.anchor)) for views in sets]
    plain = maps(network, capture, sets)
    error = mean_error(plain, truth)
    print(f"{capture.path.name}, {len(sets)} view sets of 3 views, {len(capture.frames)} frames")
    print(f"  {'as it is':<11} Abs Rel {error:.4f}")
    writers: dict[str, Callable[[Capture, Path], object]] = {
        **{name: partial(save_capture, to=name, placing="link") for name in OURS},
        "TUM RGB-D": write_tum,
        "MVSNet": write_mvsnet,
        "Record3D": write_record3d,
    }
    for name, write in writers.items():
        with tempfile.TemporaryDirectory() as folder:
            write(capture, Path(folder) / "capture")
            again = open_capture(Path(folder) / "capture")
            again = again if again.metric else scaled(again, 1.0)
            found = maps(network, again, renamed(sets, capture, again))
        score = mean_error(found, truth)
        apart = np.median([np.median(abs(a / b - 1)) for a, b in zip(found, plain, strict=True)])
        print(f"  {name:<11} Abs Rel {score:.4f}, {score / error:.4f} of it, apart {apart:.1e}")


def only(capture: Capture, sets: Sequence[ViewSet]) -> Capture:
    """The frames that view sets name."""
    wanted = set(named_frames(sets))
    mask = np.array([id in wanted for id in capture.frames])
    return Capture(capture.path, capture.frames.kept(mask), {}, metric=capture.metric)


def renamed(sets: Sequence[ViewSet], capture: Capture, again: Capture) -> list[ViewSet]:
    """The view sets, by the ids of a format that knows numbers or stamps alone."""
    called = dict(zip(capture.frames, again.frames, strict=True))
    return [ViewSet(called[v.anchor], tuple(called[s] for s in v.sources)) for v in sets]


def maps(network: Predictor, capture: Capture, sets: Sequence[ViewSet]) -> Depths:
    search, config = Followed(capture.remembering()), PredictConfig()
    return [search(network, views, config).map.depth for views in sets]


def mean_error(found: Depths, truth: Sequence[NDArray[np.float32]]) -> float:
    scores = [depth_metrics(depth, true) for depth, true in zip(found, truth, strict=True)]
    return float(np.mean([score.abs_rel for score in scores if score is not None]))


def write_tum(capture: Capture, folder: Path) -> None:
    """Lists of stamps; depth in fifths of a millimetre."""
    K = capture.frames.K[0]
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    rgb, depths, poses = [], [], ["# timestamp tx ty tz qx qy qz qw"]
    for number, frame in enumerate(capture.frames.values()):
        stamp = f"{1000 + number / 30:.6f}"
        image = f"rgb/{stamp}{frame.image_path.suffix}"
        copyfile(frame.image_path, folder / image)
        steps = np.round(frame.read_depth() * TUM_STEPS)
        steps = np.where(steps > LARGEST, 0, steps).astype(np.uint16)
        Image.fromarray(steps).save(folder / f"depth/{stamp}.png")
        world_from_cam = np.linalg.inv(frame.cam_from_world)
        turn = Rotation.from_matrix(world_from_cam[:3, :3]).as_quat()
        rgb.append(f"{stamp} {image}")
        depths.append(f"{stamp} depth/{stamp}.png")
        poses.append(f"{stamp} {words([*world_from_cam[:3, 3], *turn])}")
    camera = [words([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])]
    lists = {"rgb": rgb, "depth": depths, "groundtruth": poses, "intrinsics": camera}
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")


def write_mvsnet(capture: Capture, folder: Path) -> None:
    """Cameras with the range of depth that their frames' sensor saw, as MVSNet wants one."""
    for name in ("cams", "images"):
        (folder / name).mkdir(parents=True)
    for number, frame in enumerate(capture.frames.values()):
        copyfile(frame.image_path, folder / f"images/{number:08d}{frame.image_path.suffix}")
        K = frame.K.copy()
        K[:2, 2] += CORNER
        depth = frame.read_depth()
        near, far = np.percentile(depth[depth > 0], (1, 99)) * (0.8, 1.25)
        lines = ["extrinsic", *map(words, frame.cam_from_world), "", "intrinsic", *map(words, K)]
        lines += ["", words([near, (far - near) / (PLANES - 1), PLANES, far])]
        (folder / f"cams/{number:08d}_cam.txt").write_text("\n".join(lines) + "\n")


def write_record3d(capture: Capture, folder: Path) -> None:
    """Poses with y up, looking along -z; depth in half floats."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    first = capture.frames.at(0)
    K = first.K.copy()
    K[:2, 2] += CORNER
    poses = []
    for number, frame in enumerate(capture.frames.values()):
        copyfile(frame.image_path, folder / f"rgb/{number}.jpg")
        (folder / f"depth/{number}.exr").write_bytes(exr(frame.read_depth()))
        world_from_cam = np.linalg.inv(frame.cam_from_world) @ OPENGL
        turn = Rotation.from_matrix(world_from_cam[:3, :3]).as_quat()
        poses.append([*turn, *world_from_cam[:3, 3]])
    height, width = first.image_size
    content = {"w": width, "h": height, "K": K.T.ravel().tolist(), "poses": poses, "fps": 60}
    (folder / "metadata.json").write_text(json.dumps(content))


def exr(depth: NDArray[np.float32]) -> bytes:
    """One channel of half floats, not compressed.

    Source: OpenEXR file layout, openexr.com/en/latest/OpenEXRFileLayout.html.
    """
    height, width = depth.shape

    def attribute(name: str, type: str, value: bytes) -> bytes:
        return f"{name}\0{type}\0".encode() + struct.pack("<I", len(value)) + value

    head = b"\x76\x2f\x31\x01" + struct.pack("<I", 2)
    head += attribute("channels", "chlist", b"Z\0" + struct.pack("<iIii", 1, 0, 1, 1) + b"\0")
    head += attribute("compression", "compression", b"\0")
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    head += attribute("dataWindow", "box2i", window) + b"\0"
    lines = [
        struct.pack("<iI", y, 2 * width) + row.tobytes()
        for y, row in enumerate(depth.astype("<f2"))
    ]
    places = len(head) + 8 * height + np.arange(height) * (8 + 2 * width)
    return head + places.astype("<u8").tobytes() + b"".join(lines)


def words(numbers: Sequence[float] | NDArray[np.float64]) -> str:
    return " ".join(f"{number:.12g}" for number in numbers)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
