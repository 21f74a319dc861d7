"""Poses from the same matches, by our solvers and by OpenCV's: shares of right ones side by side.

python benchmarks/pose_solvers.py CAPTURE_OR_PAIRS [--view-sets FILE] [--detectors orb sift ...]

Of a capture with depth poses are by PnP, right within 5 degrees and 5 cm; of a file of pairs by
essential matrices, right within 5, 10 and 20 degrees. OpenCV searches twice: as it does by itself
(RANSAC), and with local optimisation and a truncated cost (USAC), as ours does. The matches are
taken in --orders orders, each with another seed of ours: OpenCV has one seed, and what few matches
say is chance.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import tyro
from torch import Tensor

from deltas_geom import unproject
from deltas_geom.epipolar.fundamental import inverse_intrinsics
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.usable import usable_view_sets
from deltas_nets.captures.work_size import anchor_views, depth_at_image, fit_work_size, load_image
from deltas_nets.evaluate.detectors.capture import pairs_of
from deltas_nets.evaluate.detectors.config import TableConfig
from deltas_nets.evaluate.detectors.features import Features
from deltas_nets.evaluate.detectors.pairs_file import load_pair, matched_pixels, read_pairs
from deltas_nets.evaluate.detectors.pose.absolute import absolute_pose
from deltas_nets.evaluate.detectors.pose.relative import relative_pose_from_matches
from deltas_nets.evaluate.detectors.registry import load_extractors
from deltas_nets.evaluate.detectors.scores import PoseError, pose_error, share_within
from deltas_nets.evaluate.some_sets import evenly_spaced
from deltas_nets.losses.targets import read_nearest

Solve = Callable[["Task", int], Tensor | None]  # matches and a seed to a pose


@dataclass(frozen=True)
class Options:
    data: tyro.conf.Positional[Path]
    view_sets: Path | None = None
    detectors: tuple[str, ...] = ("orb", "sift", "ours")
    sets: int | None = None
    orders: int = 3
    work_size: tuple[int, int] | None = None


class Task(NamedTuple):
    """Matches of one pair: ``known`` are points of the world, or pixels of the first view."""

    detector: str
    known: Tensor
    pixels: Tensor
    K: Tensor
    true: Tensor


def from_capture(options: Options) -> Iterator[Task]:
    capture = open_capture(options.data)
    view_sets = usable_view_sets(capture, options.view_sets, None).view_sets
    seen: dict[tuple[str, str], Features] = {}
    extractors = load_extractors(options.detectors)
    for pair in pairs_of(capture, evenly_spaced(view_sets, options.sets)):
        frames = [capture.frame(id) for id in pair]
        size = options.work_size or fit_work_size(frames[0].image_size)
        views = anchor_views(frames, work_size=size)
        depth = torch.from_numpy(depth_at_image(frames[0], work_size=size))
        for name, extract, _ in extractors:
            for frame in frames:
                if (name, frame.id) not in seen:
                    image = load_image(frame, work_size=size)
                    seen[name, frame.id] = extract(image, TableConfig().detection)
            one, two = matched_pixels(*(seen[name, id] for id in pair))
            z = read_nearest(depth, one)
            points = unproject(views.select([0]), one[None, z > 0], z[None, z > 0])[0]
            yield Task(name, points, two[z > 0], views.K[1], views.cam_from_world[1])


def from_pairs(options: Options) -> Iterator[Task]:
    config = replace(TableConfig(), work_size=options.work_size)
    extractors = load_extractors(options.detectors)
    for pair in evenly_spaced(read_pairs(options.data), options.sets):
        images, K = load_pair(pair, config)
        for name, extract, _ in extractors:
            found = [extract(image, config.detection) for image in images]
            one, two = matched_pixels(*found)
            yield Task(name, one, two, K, pair.second_from_first)


def ours_absolute(task: Task, seed: int) -> Tensor | None:
    config = replace(TableConfig().pnp, seed=seed)
    found = absolute_pose(task.known, task.pixels, task.K, config)
    return None if found is None else found.model


def ours_relative(task: Task, seed: int) -> Tensor | None:
    config = replace(TableConfig().essential, seed=seed)
    found = relative_pose_from_matches(task.known, task.pixels, task.K, config)
    return None if found is None else found.model


def opencv_absolute(task: Task, seed: int, *, usac: bool) -> Tensor | None:
    if len(task.known) < 5:
        return None
    known, pixels, K = (part.double().numpy() for part in (task.known, task.pixels, task.K))
    config = TableConfig().pnp
    try:
        if usac:
            found = cv2.solvePnPRansac(known, pixels, K, None, params=usac_of(config.threshold))
            ok, turn, shift = (found[0], *found[-3:-1]) if len(found) > 4 else found[:3]
        else:
            ok, turn, shift, _ = cv2.solvePnPRansac(
                known,
                pixels,
                K,
                None,
                iterationsCount=config.most,
                reprojectionError=config.threshold,
                confidence=config.confidence,
            )
    except cv2.error:  # too few inliers for its refinement
        return None
    return pose_of(cv2.Rodrigues(turn)[0], shift) if ok else None


def opencv_relative(task: Task, seed: int, *, usac: bool) -> Tensor | None:
    if len(task.known) < 6:
        return None
    config, K = TableConfig().essential, task.K
    one, two = (
        (torch.nn.functional.pad(pixels.double(), (0, 1), value=1) @ inverse_intrinsics(k).mT)
        for pixels, k in zip((task.known, task.pixels), K, strict=True)
    )
    one, two = one[:, :2].numpy(), two[:, :2].numpy()
    threshold = config.threshold / float(K[:, [0, 1], [0, 1]].mean())
    essential, inliers = cv2.findEssentialMat(
        one,
        two,
        np.eye(3),
        method=cv2.USAC_DEFAULT if usac else cv2.RANSAC,
        prob=config.confidence,
        threshold=threshold,
        maxIters=config.most,
    )
    if essential is None or essential.shape != (3, 3):
        return None
    _, turn, shift, _ = cv2.recoverPose(essential, one, two, np.eye(3), mask=inliers)
    return pose_of(turn, shift)


def usac_of(threshold: float) -> cv2.UsacParams:
    params = cv2.UsacParams()
    params.threshold, params.confidence = threshold, TableConfig().pnp.confidence
    params.maxIterations = TableConfig().pnp.most
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    params.score = cv2.SCORE_METHOD_MSAC
    return params


def pose_of(turn: np.ndarray, shift: np.ndarray) -> Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = torch.from_numpy(turn), torch.from_numpy(shift.ravel())
    return pose


def main() -> None:
    options = tyro.cli(Options)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    of_pairs = options.data.is_file()
    solvers: dict[str, Solve] = {
        "ours": ours_relative if of_pairs else ours_absolute,
        "RANSAC": lambda t, s: (opencv_relative if of_pairs else opencv_absolute)(t, s, usac=False),
        "USAC": lambda t, s: (opencv_relative if of_pairs else opencv_absolute)(t, s, usac=True),
    }
    errors: dict[tuple[str, str], list[PoseError]] = defaultdict(list)
    for task in (from_pairs if of_pairs else from_capture)(options):
        for seed in range(options.orders):
            order = torch.randperm(len(task.known), generator=torch.Generator().manual_seed(seed))
            mixed = task._replace(known=task.known[order], pixels=task.pixels[order])
            for name, solve in solvers.items():
                error = pose_error(solve(mixed, seed), task.true)
                errors[task.detector, name].append(error)
                errors["all", name].append(error)
    limits = (
        [("rotation", limit) for limit in (5.0, 10.0, 20.0)]
        + [("direction", limit) for limit in (5.0, 10.0, 20.0)]
        if of_pairs
        else [("rotation", 1.0), ("rotation", 5.0), ("translation", 0.03), ("translation", 0.05)]
    )
    print(f"{options.data.name}: {options.orders} orders, OpenCV {cv2.__version__}")
    print(f"{'right, %':16}{'':8}" + "".join(f"{of[:5]:>8} {limit:<5g}" for of, limit in limits))
    for (detector, name), found in errors.items():
        shares = [share_within([getattr(e, of) for e in found], limit) for of, limit in limits]
        print(f"{detector[:15]:16}{name:8}" + "".join(f"{100 * share:13.1f}" for share in shares))


if __name__ == "__main__":
    main()
