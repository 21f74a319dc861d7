"""Pixels to rays through lenses, beside OpenCV and COLMAP: answers first, then ratios.

python benchmarks/lenses.py

Processor time of one thread, 100 000 pixels in float64, those that every library finds. OpenCV
iterates until it is as accurate as ours, or 500 times; goals in brackets are 'at least'.
"""

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from deltas_geom import Lens

NUM_PIXELS, REPEATS = 100_000, 15
WIDTH, HEIGHT = 1280, 960
GOAL = "2"
MODELS: dict[str, list[float]] = {
    "SIMPLE_RADIAL": [-0.05],
    "RADIAL": [-0.25, 0.06],
    "OPENCV": [-0.25, 0.06, 1e-3, -5e-4],
    "FULL_OPENCV": [0.3, 0.1, 1e-3, -2e-3, 0.02, 0.5, 0.2, 0.03],
    "FOV": [0.9],
    "DIVISION": [-0.3],
    "EUCM": [0.6, 1.1],
    "OPENCV_FISHEYE": [0.05, -0.01, 0.002, -0.0005],
    "RADIAL_FISHEYE": [-0.03, 0.002],
    "THIN_PRISM_FISHEYE": [-0.05, 0.01, 1e-3, -2e-3, 1e-3, 0, 1e-3, 2e-3],
    "RAD_TAN_THIN_PRISM_FISHEYE": [-0.05, 0.01, 1e-3, 0, 0, 0, 1e-3, -2e-3, 1e-3, 5e-4, 2e-3, 0],
}
Array = NDArray[Any]
Peer = Callable[[], Array]
"""Gives slopes x / z and y / z."""


def lens_of(model: str) -> Lens:
    K = torch.tensor([[700.0, 0, 640], [0, 700, 470], [0, 0, 1]], dtype=torch.float64)
    return Lens(K, torch.tensor(MODELS[model], dtype=torch.float64), model)


def pixels_of() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    drawn = torch.rand(NUM_PIXELS, 2, dtype=torch.float64, generator=generator)
    return drawn * torch.tensor([WIDTH, HEIGHT]) - 0.5


def error(lens: Lens, pixels: torch.Tensor, slopes: Array) -> float:
    """The largest distance from the pixels, px, of where the slopes are seen."""
    points = torch.from_numpy(np.concatenate([slopes, np.ones((len(slopes), 1))], axis=-1))
    back, _ = lens.project(points)
    return float((back - pixels).abs().max())


def opencv(lens: Lens, pixels: torch.Tensor) -> dict[str, Peer]:
    K, dist, given = lens.K.numpy(), lens.coefficients.numpy(), pixels.numpy()[:, None].copy()
    if lens.model == "OPENCV_FISHEYE":
        undistort: Any = cv2.fisheye.undistortPoints
    elif "OPENCV" in lens.model:
        undistort = cv2.undistortPoints
    else:
        return {}

    def run(count: int) -> Array:
        settled = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, count, 1e-15)
        slopes: Array = undistort(given, K, dist, criteria=settled)[:, 0]
        return slopes

    counts = [k for k in (5, 10, 20, 40, 80, 160, 320) if error(lens, pixels, run(k)) < 1e-9]
    count = counts[0] if counts else 500
    return {f"OpenCV, {count} iterations": lambda: run(count)}


def colmap(lens: Lens, pixels: torch.Tensor) -> dict[str, Peer]:
    try:
        import pycolmap
    except ImportError:
        return {}
    camera = pycolmap.Camera(
        model=lens.model, width=WIDTH, height=HEIGHT, params=lens.to_colmap().numpy()
    )
    given = pixels.numpy() + 0.5

    def run() -> Array:
        slopes: Array = camera.cam_from_img(given)
        return slopes

    return {"pycolmap": run}


def milliseconds(*runs: Callable[[], object]) -> list[float]:
    """Least processor time of a call, the runs taken in turns."""
    least = [float("inf")] * len(runs)
    for _ in range(REPEATS):
        for k, run in enumerate(runs):
            began = time.process_time()
            run()
            least[k] = min(least[k], 1e3 * (time.process_time() - began))
    return least


@torch.no_grad()
def main() -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for model in MODELS:
        lens, pixels = lens_of(model), pixels_of()
        rays, valid = lens.unproject(pixels)
        pixels = pixels[valid & (rays[:, 2] > 0.1)].contiguous()
        rays, _ = lens.unproject(pixels)
        missed = error(lens, pixels, (rays[:, :2] / rays[:, 2:]).numpy())
        assert missed < 1e-9, missed
        peers = opencv(lens, pixels) | colmap(lens, pixels)
        ours, *theirs = milliseconds(lambda: lens.unproject(pixels), *peers.values())  # noqa: B023
        shown = "  ".join(
            f"{name} {ms:.1f} = {ms / ours:.1f}x ({GOAL}), {error(lens, pixels, run()):.0e} px"
            for (name, run), ms in zip(peers.items(), theirs, strict=True)
        )
        seen = f"{len(pixels) / NUM_PIXELS:.1%} of pixels"
        print(f"{model:<27} {ours:6.1f} ms, {missed:.0e} px, {seen}   {shown}", flush=True)


if __name__ == "__main__":
    main()
