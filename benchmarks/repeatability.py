"""Repeatability of interest points on a capture with depth: ours, teachers', classical ones.

python benchmarks/repeatability.py --capture DIR [--view-sets FILE] [--weights FILE ...]
    [--teachers aliked=FILE ...]

Every anchor of the view sets is compared with each of its sources, at the size that the network
works at. `deltas detectors` has the whole of the paper's table 1; this has Shi-Tomasi and ORB by
itself besides. The row "spread" is even coverage that has not looked at the image: what chance
gives.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import kornia
import skimage
import torch
import tyro
from kornia.feature import gftt_response
from skimage.feature import ORB
from torch import Tensor

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.usable import usable_view_sets
from deltas_nets.captures.work_size import depth_at_image, fit_work_size, load_views
from deltas_nets.distill.teachers import load_teacher
from deltas_nets.evaluate.repeatability import (
    NUM_POINTS,
    TOLERANCE,
    Repeatability,
    pooled,
    repeatability,
    strongest_points,
)
from deltas_nets.evaluate.scores import resize_nearest
from deltas_nets.network.lite.detector import detector_heatmap, spread_points
from deltas_nets.weights_file import load_model

Detect = Callable[[Tensor], Tensor]  # image (3, H, W) to points (N, 2)


@dataclass(frozen=True)
class Options:
    """Print shares of repeated points and of pairs, and the mean error of repeated points, px."""

    capture: Path
    """Folder with images, poses and depth."""
    view_sets: Path | None = None
    """JSON of anchors and sources; view_sets.json of the capture if not given."""
    weights: tuple[str, ...] = ("deltas-small",)
    """Networks of ours: shipped names or files."""
    teachers: tuple[str, ...] = ()
    """NAME=FILE of published weights, as aliked=aliked-n16.pth."""
    num_points: int = NUM_POINTS
    """Points of every image."""
    tolerance: float = TOLERANCE
    """Pixels at the working size."""
    nms_radius: int = 4
    """Of every detector but ORB, which has its own suppression."""


def ours(weights: str, options: Options) -> Detect:
    model = load_model(weights)

    def detect(image: Tensor) -> Tensor:
        size = (image.shape[-2], image.shape[-1])
        features = model.encoder(image[None, None])
        logits = model.detector(features, image_size=size).logits
        return of_map(detector_heatmap(logits, image_size=size), options)

    return detect


def of_teacher(name_and_file: str, options: Options) -> Detect:
    name, _, file = name_and_file.partition("=")
    teacher = load_teacher(name, file)
    return lambda image: of_map(teacher(image[None]), options)


def shi_tomasi(image: Tensor, options: Options) -> Tensor:
    return of_map(gftt_response(image.mean(dim=0)[None, None]), options)


def of_map(scores: Tensor, options: Options) -> Tensor:
    return strongest_points(scores, options.num_points, nms_radius=options.nms_radius)


def orb(image: Tensor, options: Options) -> Tensor:
    """The best points of ORB by itself, which suppresses within 1 px of each scale alone."""
    return orb_points(image, options.num_points)


def thinned_orb(image: Tensor, options: Options) -> Tensor:
    """The best points of ORB that keep the same distance as those of the other detectors."""
    points = orb_points(image, 20 * options.num_points)
    kept: list[int] = []
    for number, point in enumerate(points):
        near = (points[kept] - point).abs().amax(dim=-1) <= options.nms_radius
        if not bool(near.any()):
            kept.append(number)
        if len(kept) == options.num_points:
            break
    return points[kept]


def orb_points(image: Tensor, count: int) -> Tensor:
    """ORB's points ``(n, 2)``, strongest first."""
    detector = ORB(n_keypoints=count)
    detector.detect(image.mean(dim=0).numpy())
    order = detector.responses.argsort()[::-1]
    return torch.from_numpy(detector.keypoints[order][:, ::-1].copy()).float()


def spread(image: Tensor, options: Options) -> Tensor:
    return spread_points(options.num_points, image_size=(image.shape[-2], image.shape[-1]))


def detectors(options: Options) -> dict[str, Detect]:
    found = {f"ours: {Path(name).stem}": ours(name, options) for name in options.weights[:1]}
    for name in options.weights[1:]:
        found[f"ours: {name[-40:]}"] = ours(name, options)
    for teacher in options.teachers:
        name, _, file = teacher.partition("=")
        found[f"{name}: {Path(file).stem}"] = of_teacher(teacher, options)
    return found | {
        "ORB (scikit-image)": lambda image: orb(image, options),
        "ORB, thinned": lambda image: thinned_orb(image, options),
        "Shi-Tomasi": lambda image: shi_tomasi(image, options),
        "spread": lambda image: spread(image, options),
    }


def depth_of(capture: Capture, id: int, size: tuple[int, int]) -> Tensor:
    return torch.from_numpy(resize_nearest(depth_at_image(capture.frame(id)), size))


@torch.no_grad()
def main() -> None:
    options = tyro.cli(Options)
    torch.set_num_threads(1)
    capture = open_capture(options.capture)
    file = options.view_sets or options.capture / "view_sets.json"
    view_sets = usable_view_sets(capture, file if file.is_file() else None, None).view_sets
    named = detectors(options)
    points: dict[tuple[str, int], Tensor] = {}
    pairs: dict[str, list[Repeatability]] = {name: [] for name in named}
    for anchor, sources in view_sets:
        ids = (anchor, *sources)
        frames = [capture.frame(id) for id in ids]
        size = fit_work_size(frames[0].image_size)
        images, views = load_views(frames, work_size=size)
        depth = torch.stack([depth_of(capture, id, size) for id in ids])
        for name, detect in named.items():
            for id, image in zip(ids, images, strict=True):
                if (name, id) not in points:
                    points[name, id] = detect(image)
            for number, source in enumerate(sources, start=1):
                pair = [0, number]
                found = (points[name, anchor], points[name, source])
                score = repeatability(
                    views.select(pair), depth[pair], *found, tolerance=options.tolerance
                )
                pairs[name].append(score)
    count = len(next(iter(pairs.values())))
    print(
        f"{options.capture.name}: {count} pairs of {len(view_sets)} anchors, {size[1]} x {size[0]}"
    )
    print(
        f"{options.num_points} points, {options.tolerance} px, suppression {options.nms_radius} px"
    )
    print(f"torch {torch.__version__}, kornia {kornia.__version__}, skimage {skimage.__version__}")
    print(f"{'':48}{'repeated %':>11}{'one to one %':>14}{'error px':>10}{'points':>8}")
    for name, scores in pairs.items():
        total = pooled(scores)
        mean = sum(len(found) for (of, _), found in points.items() if of == name) / sum(
            of == name for of, _ in points
        )
        shares = f"{100 * total.share:11.1f}{100 * total.one_to_one:14.1f}"
        print(f"{name:48}{shares}{total.error:10.2f}{mean:8.0f}")


if __name__ == "__main__":
    main()
