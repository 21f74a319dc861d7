"""Captures that other programs wrote: their matches lie on the epipolar lines that we read."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from epipolar_residual import Seen, residual, seen_in, true_matches
from scipy.spatial.transform import Rotation, Slerp

from deltas_nets.captures.opening import open_capture

pytestmark = pytest.mark.shared


def _rigid(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.block([[R, np.reshape(t, (3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


def _tum(folder: Path) -> list[Seen]:
    poses = np.loadtxt(folder / "groundtruth.txt")
    turns = Slerp(poses[:, 0], Rotation.from_quat(poses[:, 4:]))
    K = np.array([[517.306408, 0, 318.643040], [0, 516.469215, 255.313989], [0, 0, 1]])
    bends = (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
    images = sorted((folder / "rgb").iterdir())
    times = [float(file.stem) for file in images]
    centres = np.stack([np.interp(times, poses[:, 0], poses[:, 1 + i]) for i in range(3)], 1)
    cams = [
        np.linalg.inv(_rigid(turn.as_matrix(), c))
        for turn, c in zip(turns(times), centres, strict=True)
    ]
    return [Seen(file, K, bends, cam) for file, cam in zip(images, cams, strict=True)]


def _robustmvd(folder: Path) -> list[Seen]:
    each = [folder / "key", *sorted((folder / "source").iterdir())]
    read = [(np.load(f / "K.npy"), np.load(f / "to_ref_transform.npy")) for f in each]
    return [
        Seen(f / "image.png", K.astype(float), (0, 0, 0, 0), T.astype(float))
        for f, (K, T) in zip(each, read, strict=True)
    ]


def _opensfm(folder: Path) -> list[Seen]:
    (scene,) = json.loads((folder / "reconstruction_example.json").read_text())
    found = []
    for name, shot in sorted(scene["shots"].items()):
        camera = scene["cameras"][shot["camera"]]
        w, h = camera["width"], camera["height"]
        f = camera["focal"] * max(w, h)
        K = np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])
        R = cv2.Rodrigues(np.array(shot["rotation"]))[0]
        cam = _rigid(R, np.array(shot["translation"]))
        found.append(Seen(folder / "images" / name, K, (camera["k1"], camera["k2"], 0, 0), cam))
    return found


def _openmvg(folder: Path) -> list[Seen]:
    scene = json.loads(next(folder.rglob("sfm_data.json")).read_text())
    camera = scene["intrinsics"][0]["value"]["ptr_wrapper"]["data"]
    (cx, cy), f = camera["principal_point"], camera["focal_length"]
    k1, k2, k3 = camera["disto_k3"]
    K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
    poses = {pose["key"]: pose["value"] for pose in scene["extrinsics"]}
    found = []
    for view in (view["value"]["ptr_wrapper"]["data"] for view in scene["views"]):
        R, c = (np.array(poses[view["id_pose"]][name]) for name in ("rotation", "center"))
        file = folder / "images" / view["filename"]
        found.append(Seen(file, K, (k1, k2, 0, 0, k3), _rigid(R, -R @ c)))
    return found


def _kapture(folder: Path) -> list[Seen]:
    K = np.array([[1847.53, 0, 959], [0, 1847.53, 539], [0, 0, 1]])
    table = np.loadtxt(folder / "sensors/trajectories.txt", delimiter=",", usecols=range(2, 9))
    cams = [_rigid(Rotation.from_quat(row[[1, 2, 3, 0]]).as_matrix(), row[4:]) for row in table]
    files = sorted((folder / "sensors/records_data").iterdir())
    return [Seen(file, K, (0, 0, 0, 0), cam) for file, cam in zip(files, cams, strict=True)]


SAMPLES: dict[str, tuple[Callable[[Path], list[Seen]], tuple[int, int], bool, float]] = {
    "tum": (_tum, (0, 8), True, 2.0),
    "robustmvd": (_robustmvd, (0, 2), True, 3.0),
    "opensfm": (_opensfm, (0, 1), False, 3.0),
    "openmvg": (_openmvg, (0, 2), False, 1.0),
    "kapture": (_kapture, (0, 1), False, 3.0),
}
"""An independent reading, two views, whether metric, and px that the residual stays below."""


@pytest.mark.parametrize("name", SAMPLES)
def test_matches_lie_on_the_epipolar_lines_as_in_an_independent_reading(
    name: str, shared_data: Path
) -> None:
    by_hand, (first, second), metric, limit = SAMPLES[name]
    folder = shared_data / "formats" / name
    views, capture = by_hand(folder), open_capture(folder)
    assert (len(capture.frames), capture.metric, capture.lost) == (len(views), metric, {})
    by_file = {capture.frames.at(i).image_path: capture.frames.id_at(i) for i in range(len(views))}
    a, b = views[first], views[second]
    ours = seen_in(capture, [by_file[a.image], by_file[b.image]])
    matches = true_matches(a.image, b.image)
    theirs = residual(a, b, matches)
    assert residual(*ours, matches) < 1.2 * theirs
    assert theirs < limit
