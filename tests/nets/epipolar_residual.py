"""How far true matches lie from their epipolar lines, in OpenCV's terms: a check of poses and K."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from deltas_nets.captures.capture import Capture


class Seen(NamedTuple):
    """An image with what OpenCV needs of its camera; no fisheye."""

    image: Path
    K: np.ndarray
    bends: Sequence[float]
    cam_from_world: np.ndarray


_ORDER = {
    "SIMPLE_RADIAL": lambda k: (k, 0, 0, 0),
    "RADIAL": lambda k1, k2: (k1, k2, 0, 0),
    "OPENCV": lambda *four: four,
    "FULL_OPENCV": lambda *eight: eight,
}


def seen_in(capture: Capture, ids: Sequence[str]) -> list[Seen]:
    """What a reader made of some frames."""
    frames = [capture.frame(id) for id in ids]
    bends = [
        (0.0,) * 4 if f.lens is None else _ORDER[f.lens.model](*f.lens.coefficients) for f in frames
    ]
    return [
        Seen(f.image_path, f.K, b, f.cam_from_world) for f, b in zip(frames, bends, strict=True)
    ]


def true_matches(a: Path, b: Path) -> tuple[np.ndarray, np.ndarray]:
    """SIFT matches that some fundamental matrix explains, whatever the poses say."""
    (at, of_a), (bt, of_b) = map(_keypoints, (a, b))
    pairs = [
        (at[first.queryIdx], bt[first.trainIdx])
        for first, second in cv2.BFMatcher().knnMatch(of_a, of_b, k=2)
        if first.distance < 0.75 * second.distance
    ]
    pixels = np.array(pairs).reshape(-1, 2, 2)
    cv2.setRNGSeed(0)
    _, inside = cv2.findFundamentalMat(pixels[:, 0], pixels[:, 1], cv2.USAC_MAGSAC, 2.0, 0.9999)
    kept = pixels[inside.ravel() > 0]
    assert len(kept) > 50
    return kept[:, 0], kept[:, 1]


def _keypoints(path: Path) -> tuple[np.ndarray, np.ndarray]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    smaller = 1
    while image.shape[1] > 1700:
        image, smaller = cv2.pyrDown(image), 2 * smaller
    found, described = cv2.SIFT_create(3000).detectAndCompute(image, None)
    # Pixel x of the smaller image is centred on pixel 2 x of the larger, as pyrDown samples it.
    return smaller * np.array([keypoint.pt for keypoint in found]), described


def residual(a: Seen, b: Seen, matches: tuple[np.ndarray, np.ndarray]) -> float:
    """Median distance, px, of matches in ``b`` from the lines of ``a``."""
    straight = [
        cv2.undistortPoints(pixels[:, None].copy(), view.K, np.array(view.bends), P=view.K)[:, 0]
        for view, pixels in zip((a, b), matches, strict=True)
    ]
    b_from_a = b.cam_from_world @ np.linalg.inv(a.cam_from_world)
    x, y, z = b_from_a[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ b_from_a[:3, :3]
    fundamental = np.linalg.inv(b.K).T @ essential @ np.linalg.inv(a.K)
    lines = cv2.computeCorrespondEpilines(straight[0], 1, fundamental)[:, 0]
    return float(np.median(np.abs((lines[:, :2] * straight[1]).sum(1) + lines[:, 2])))
