"""Depth of one capture through other lenses and in other units, beside depth of it as it is.

    python benchmarks/lenses_and_units.py CAPTURE VIEW_SETS.json [EVERY]

Lenses: photos and sensor depth are rendered again through a pinhole, an OpenCV and a fisheye
camera, written as COLMAP, transforms.json and our own format, and scored on the pixels that both
the lens and the pinhole see. Units: the capture is declared to be without metres and scaled; maps
must agree but for the unit.
"""

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image

from deltas_geom import Lens
from deltas_geom.cameras.pixels import normalize_pixels, pixel_grid
from deltas_nets import open_capture
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.frame import Lens as FrameLens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.saving import save_capture
from deltas_nets.captures.scaled import scaled
from deltas_nets.captures.view_sets import ViewSet, read_view_sets
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.evaluate.depth_metrics import depth_metrics
from deltas_nets.predict.depth_map import PredictConfig, frames_of
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import Predictor, load_predictor
from deltas_nets.predict.reach import ROOM, Reach
from deltas_nets.predict.search import Followed

LENSES = {
    "OPENCV": (-0.12, 0.03, 0.001, -0.001),
    "OPENCV_FISHEYE": (0.03, -0.01, 0.004, -0.001),
}
LONGER = 1.3
"""Times the photo's focal length: then every pixel of every lens shows something of the photo."""
FORMATS = ("colmap", "transforms", "own")
UNITS = (0.02, 0.27, 5.0, 1000.0)
Depths = list[NDArray[np.float32]]


def main() -> None:
    capture = open_capture(sys.argv[1])
    every = int(sys.argv[3]) if len(sys.argv) > 3 else 1
    sets = read_view_sets(Path(sys.argv[2]), capture)[::every]
    sets = tuple(views._replace(sources=views.sources[:2]) for views in sets)
    network = load_predictor("deltas-small")
    with tempfile.TemporaryDirectory() as folder:
        measure_lenses(network, capture, sets, Path(folder))
    measure_units(network, capture, sets)


def measure_lenses(
    network: Predictor, capture: Capture, sets: Sequence[ViewSet], folder: Path
) -> None:
    rendered = {
        name: render(capture, sets, folder / name, name, coefficients)
        for name, coefficients in {"PINHOLE": (), **LENSES}.items()
    }
    truth = {
        name: [depth_at_image(it.frame(v.anchor)) for v in sets] for name, it in rendered.items()
    }
    plain = mean_error(maps(network, rendered["PINHOLE"], sets), truth["PINHOLE"])
    print(f"pinhole, rendered again: Abs Rel {plain:.4f} on all its pixels")
    for name in LENSES:
        both = [seen_by_both(rendered[name], rendered["PINHOLE"], views) for views in sets]
        lens_truth = [np.where(mask, t, 0) for (mask, _), t in zip(both, truth[name], strict=True)]
        pin_truth = [
            np.where(mask, t, 0) for (_, mask), t in zip(both, truth["PINHOLE"], strict=True)
        ]
        plain = mean_error(maps(network, rendered["PINHOLE"], sets), pin_truth)
        for to in FORMATS:
            save_capture(rendered[name], folder / f"{name}-{to}", to)
            again = scaled(open_capture(folder / f"{name}-{to}"), 1.0)  # COLMAP knows no metres
            error = mean_error(maps(network, again, sets), lens_truth)
            print(f"{name} as {to}: {error:.4f}, pinhole there {plain:.4f}: {error / plain:.3f}")


def measure_units(network: Predictor, capture: Capture, sets: Sequence[ViewSet]) -> None:
    truth = [depth_at_image(capture.frame(views.anchor)) for views in sets]
    metric = mean_error(maps(network, capture, sets), truth)
    print(f"in metres: Abs Rel {metric:.4f}")
    of_one: Depths = []
    for unit in (1.0, *UNITS):
        search = Followed(scaled(capture, unit, metric=False))
        found = [search(network, views, PredictConfig()).map.depth / unit for views in sets]
        of_one = of_one or found
        apart = max(float(np.abs(a / b - 1).max()) for a, b in zip(found, of_one, strict=True))
        print(f"unit {unit:g}: Abs Rel {mean_error(found, truth):.4f}, apart {apart:.1e}")


def maps(network: Predictor, capture: Capture, sets: Sequence[ViewSet]) -> Depths:
    config = PredictConfig()
    return [look(network, frames_of(capture, v), config, Reach(*ROOM)).depth for v in sets]


def mean_error(found: Depths, truth: Sequence[NDArray[np.float32]]) -> float:
    scores = [depth_metrics(depth, true) for depth, true in zip(found, truth, strict=True)]
    return float(np.mean([score.abs_rel for score in scores if score is not None]))


def render(
    capture: Capture,
    sets: Sequence[ViewSet],
    folder: Path,
    model: str,
    coefficients: tuple[float, ...],
) -> Capture:
    """Photos and depth as a camera in the same place would have them, 0 where nothing is known."""
    folder.mkdir()
    frames = []
    for id in dict.fromkeys(id for views in sets for id in (views.anchor, *views.sources)):
        frame = capture.frame(id)
        pixels = torch.from_numpy(frame.read_image().copy()).permute(2, 0, 1)[None].float()
        places = old_pixels(frame, model, coefficients)
        grid = normalize_pixels(places, image_size=frame.image_size).float()[None]
        image = F.grid_sample(pixels, grid, align_corners=False)[0].round().byte()
        Image.fromarray(image.permute(1, 2, 0).numpy()).save(folder / f"{id}.png")
        depth = torch.from_numpy(depth_at_image(frame))[None, None]
        seen = F.grid_sample(depth, grid, mode="nearest", align_corners=False)[0, 0]
        steps = (1000 * seen).round().int().numpy().astype(np.uint16)
        Image.fromarray(steps).save(folder / f"{id}.depth.png")
        lens = FrameLens(model, coefficients) if coefficients else None
        frames.append(
            replace(
                frame, image_path=folder / f"{id}.png", depth_path=folder / f"{id}.depth.png",
                K=of_render(frame), depth_K=None, depth_size=frame.image_size, lens=lens,
            )
        )  # fmt: skip
    return replace(capture, path=folder, frames=Frames.of(frames, folder), lost={})


def of_render(frame: Frame) -> NDArray[np.float64]:
    """K of what is rendered of a photo."""
    K: NDArray[np.float64] = frame.K * [[LONGER, 1, 1], [1, LONGER, 1], [1, 1, 1]]
    return K


def old_pixels(frame: Frame, model: str, coefficients: tuple[float, ...]) -> torch.Tensor:
    """``(H, W, 2)`` where the photo, a pinhole's, has the pixels of another camera with its K."""
    lens = Lens(
        torch.tensor(of_render(frame)), torch.tensor(coefficients, dtype=torch.float64), model
    )
    rays = lens.unproject(pixel_grid(frame.image_size, dtype=torch.float64))
    at = Lens(torch.tensor(frame.K), torch.zeros(0), "PINHOLE").project(rays.rays)
    known = (rays.valid & at.valid)[:, None]
    return torch.where(known, at.pixels, -9.0).reshape(*frame.image_size, 2)


def seen_by_both(
    bent: Capture, plain: Capture, views: ViewSet
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which pixels of a lens's photo the pinhole sees, too, and the other way round."""
    frame, other = bent.frame(views.anchor), plain.frame(views.anchor)
    assert frame.lens is not None
    height, width = frame.image_size

    def inside(pixels: torch.Tensor) -> NDArray[np.bool_]:
        x, y = pixels.unbind(-1)
        within: torch.Tensor = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        return within.reshape(height, width).numpy()

    K = torch.tensor(other.K)  # of both
    grid = pixel_grid(frame.image_size, dtype=torch.float64)
    lens = Lens(K, torch.tensor(frame.lens.coefficients, dtype=torch.float64), frame.lens.model)
    pinhole = Lens(K, K.new_zeros(0), "PINHOLE")
    return (
        inside(pinhole.project(lens.unproject(grid).rays).pixels),
        inside(lens.project(pinhole.unproject(grid).rays).pixels),
    )


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
