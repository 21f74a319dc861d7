"""Which frames are looked at together, chosen by geometry where no file says it."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from deltas_geom.checks import check_kind
from deltas_nets.captures.capture import Capture, FloatArray
from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.known_depths import points_in_view
from deltas_nets.captures.seen_places import seen_places
from deltas_nets.captures.straight import WIDEST, lens_of
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.working_depth import working_depths
from deltas_nets.errors import UserError

__all__ = ["ChosenViews", "choose_view_sets", "choose_views", "spread_sources"]

PROBE_DEPTHS = (0.4, 0.8, 1.6)
"""Where surfaces may be, in working depths: overlap is the mean over these."""
NEAR_PROBE = 0.2
"""Where few surfaces are, but the first to leave the images of a camera that walks ahead: a second
source gains by what it sees there, and no source is refused for what it does not."""
PROBES_ACROSS = 8  # columns and rows of anchor pixels probed
MAX_POINTS = 256  # sparse points that are probed in their place where the anchor sees some

GOOD_BASELINES = (0.06, 0.10)
"""In working depths. Below, half a pixel of matching error is too much depth; above, patches
look different and overlap shrinks. The score falls off on both sides."""
MAX_BASELINE = 0.25  # in working depths; beyond, a frame is not even scored
MIN_BASELINE = 0.01
MIN_OVERLAP = 0.4
MAX_ANGLE = np.radians(45)
MAX_ROLL = np.radians(45)
"""Images turned farther about the axis, as portrait is beside landscape, hardly match."""
GOOD_ANGLE = np.radians(15)  # where the penalty of the viewing angle reaches exp(-1/2)
NEAREST = 0.04  # in working depths; what is nearer to a candidate does not count as seen
COVERAGE = 12.0
"""How much a source gains by the log of the part of the anchor that is seen with it, by the part
that is seen without."""
MAX_CANDIDATES = 48  # frames scored by projection for each anchor, where no more are wanted


class ChosenViews(NamedTuple):
    """What was chosen.

    Attributes:
        view_sets: one for each anchor.
        short: how many sets have fewer views than asked, by what hinders most other frames.
    """

    view_sets: tuple[ViewSet, ...]
    short: Mapping[str, int]


def choose_view_sets(
    capture: Capture,
    num_views: int,
    *,
    working_depth: float | None = None,
    anchors: Iterable[str | int] | None = None,
) -> tuple[ViewSet, ...]:
    """Choose sources for every frame by baseline, viewing angle and overlap.

    A frame without an acceptable source gets the best there are; otherwise only acceptable
    sources are chosen, so a set may have fewer than ``num_views - 1``.

    Args:
        capture: two frames or more.
        num_views: the anchor and at most ``num_views - 1`` sources.
        working_depth: how far typical surfaces are, in the capture's unit: good baselines are 6 to
            10 % of it. Of each frame as `deltas_nets.captures.working_depth` says if not given.
        anchors: frames that want a set; all by default.

    Raises:
        UserError: the capture has one frame only, or an anchor that it does not have.
    """
    return choose_views(capture, num_views, working_depth=working_depth, anchors=anchors).view_sets


def choose_views(
    capture: Capture,
    num_views: int,
    *,
    working_depth: float | None = None,
    anchors: Iterable[str | int] | None = None,
) -> ChosenViews:
    """:func:`choose_view_sets`, and why sets are short.

    Raises:
        UserError: as there.
    """
    check_kind("capture", capture, Capture, "open_capture(PATH)")
    if num_views < 2:
        what = f"{num_views} views are too few"
        raise UserError(what, "--views", "use 2 or more: the anchor and a source")
    if len(capture.frames) < 2:
        what = f"one frame of the capture can be used ({ids_in_words(capture.frames)})"
        for words in ("no image", "no pose"):
            ids = [id for id, lost in capture.lost.items() if lost.reason == words]
            what += f"; {words}: {ids_in_words(ids)}" if ids else ""
        raise UserError(what, capture.path, "depth from views needs two frames or more")
    ids = list(capture.frames)
    index_of = {id: index for index, id in enumerate(ids)}
    wanted = ids if anchors is None else [capture.frame(id).id for id in anchors]
    depths = working_depths(capture) if working_depth is None else None
    poses = capture.frames.cam_from_world
    centres = camera_centres(poses)

    view_sets, short = [], Counter[str]()
    for id in wanted:
        anchor = index_of[id]
        depth = float(depths[anchor]) if depths is not None else working_depth or 0.0
        near = _candidates(centres, poses[:, :3, :3], anchor, depth, num_views - 1)
        (probes, rated), nearest = _probes(capture, anchor, depth), NEAREST * depth
        seen = seen_places(capture.frames, near, probes, poses[anchor], nearest=nearest)
        overlap = seen[:, :rated].mean(axis=-1)
        offsets = (centres[near] - centres[anchor]) @ poses[anchor, :3, :3].T
        angles = _angles(poses[near, 2, :3], poses[anchor, 2, :3])
        rolls = _rolls(poses[near, :3, :3], poses[anchor, :3, :3])
        log_score, hindered = _rate(offsets, angles, rolls, overlap, depth)
        acceptable = hindered == ""
        if acceptable.sum() < min(num_views, len(ids)) - 1:
            short[Counter(hindered[~acceptable]).most_common(1)[0][0]] += 1
        if acceptable.any():
            near, offsets = near[acceptable], offsets[acceptable]
            log_score, seen = log_score[acceptable], seen[acceptable]
        chosen = spread_sources(log_score, offsets, num_views - 1, seen=seen)
        view_sets.append(ViewSet(id, tuple(ids[near[index]] for index in chosen)))
    return ChosenViews(tuple(view_sets), dict(short.most_common()))


def _candidates(
    centres: FloatArray, rotations: FloatArray, anchor: int, working_depth: float, wanted: int
) -> NDArray[np.intp]:
    """Indices of the frames worth projecting into: near a good baseline, looking alike.

    Everything is ranked, so that a frame far from all others still has candidates.
    """
    baseline = np.linalg.norm(centres - centres[anchor], axis=-1) / working_depth
    angle = _angles(rotations[:, 2], rotations[anchor, 2])
    turned = _rolls(rotations, rotations[anchor]) > MAX_ROLL
    cost = -_baseline_log_score(baseline) + 0.5 * (angle / GOOD_ANGLE) ** 2
    # Behind all that are near enough, but ranked.
    cost += np.where((baseline > MAX_BASELINE) | (angle > MAX_ANGLE) | turned, 1e6, 0.0)
    cost[anchor] = np.inf
    count = min(max(MAX_CANDIDATES, wanted), len(centres) - 1)
    nearest = np.argpartition(cost, count - 1)[:count]
    # In frame order: ties of the score then go to the earlier frame, whatever numpy does.
    return np.sort(nearest)


def _angles(axes: FloatArray, axis: FloatArray) -> FloatArray:
    """Angles between viewing directions (third rows of cam_from_world), rad."""
    angles: FloatArray = np.arccos(np.clip(axes @ axis, -1.0, 1.0))
    return angles


def _rolls(rotations: FloatArray, rotation: FloatArray) -> FloatArray:
    """Angles ``(C,)`` by which cameras are turned about their axes, 0 to pi, rad."""
    turns = rotations @ rotation.T
    sine, cosine = turns[:, 1, 0] - turns[:, 0, 1], turns[:, 0, 0] + turns[:, 1, 1]
    rolls: FloatArray = np.abs(np.arctan2(sine, cosine))
    return rolls


def _baseline_log_score(baseline: FloatArray) -> FloatArray:
    """0 in the good range, falling with the square of the log-ratio to it.

    The log makes half and double equally bad, as they are for parallax and for appearance.
    """
    low, high = GOOD_BASELINES
    clipped = np.clip(baseline, low, high)
    ratio: FloatArray = np.log(np.maximum(baseline, 1e-6) / clipped)
    score: FloatArray = -0.5 * (ratio / np.log(2.0)) ** 2
    return score


def _probes(capture: Capture, anchor: int, working_depth: float) -> tuple[FloatArray, int]:
    """Places ``(3, P)`` in the anchor's camera where surfaces are, or may be.

    Besides, how many of them, from the first on, overlap is the mean of.
    """
    points = points_in_view(capture, anchor)
    if points is not None:
        points = points[:: 1 + len(points) // MAX_POINTS]
        return points.T, len(points)
    height, width = capture.frames.image_sizes[anchor]
    parts = (np.arange(PROBES_ACROSS) + 0.5) / PROBES_ACROSS
    x, y = np.meshgrid(parts * width - 0.5, parts * height - 0.5)
    rays = _rays(capture, anchor, np.stack([x.ravel(), y.ravel()]))
    depths = (*PROBE_DEPTHS, NEAR_PROBE)
    places = np.concatenate([rays * depth * working_depth for depth in depths], axis=1)
    return places, rays.shape[1] * len(PROBE_DEPTHS)


def _rays(capture: Capture, position: int, pixels: FloatArray) -> FloatArray:
    """``(3, P)`` as far as 1 along the view, of those pixels ``(2, P)`` that are made straight."""
    frame = capture.frames.at(position)
    ones: FloatArray = np.ones((1, pixels.shape[1]))
    rays: FloatArray = np.linalg.inv(frame.K) @ np.concatenate([pixels, ones])
    if frame.lens is not None:
        seen: FloatArray = lens_of(frame).unproject(torch.from_numpy(pixels.T.copy())).rays.numpy()
        seen = seen[seen[:, 2] > WIDEST].T
        return seen / seen[2] if seen.size else rays
    return rays


def _rate(
    offsets: FloatArray,
    angles: FloatArray,
    rolls: FloatArray,
    overlap: FloatArray,
    working_depth: float,
) -> tuple[FloatArray, NDArray[np.str_]]:
    """Log scores of candidates and what makes them unfit, "" if nothing; in the anchor's axes."""
    baseline = np.linalg.norm(offsets, axis=-1) / working_depth
    # Parallax comes from moving sideways; moving along the view leaves its centre without any.
    sideways = np.linalg.norm(offsets[:, :2], axis=-1) / working_depth
    effective = np.sqrt(sideways**2 + 0.25 * (offsets[:, 2] / working_depth) ** 2)
    score = _baseline_log_score(effective)
    score = score - 0.5 * (angles / GOOD_ANGLE) ** 2 + 2.0 * np.log(np.maximum(overlap, 1e-3))
    hindered = np.select(
        [
            baseline < MIN_BASELINE,
            baseline > MAX_BASELINE,
            angles > MAX_ANGLE,
            rolls > MAX_ROLL,
            overlap < MIN_OVERLAP,
        ],
        [
            "stand in the same place",
            "stand too far away",
            "look elsewhere",
            "are turned",
            "see little of it",
        ],
        default="",
    )
    return score, hindered


def spread_sources(
    log_score: FloatArray,
    offsets: FloatArray,
    count: int,
    *,
    seen: NDArray[np.bool_] | None = None,
) -> list[int]:
    """Choose the best one by one, each discounted by how nearly it repeats one that was chosen.

    A second view from the same place adds little; one from the opposite side sees what the
    first cannot, and its errors differ. What no source sees is guessed, so a view gains by what
    those before it do not see: of a camera that walks ahead, a frame that is still near.

    Args:
        log_score: ``(C,)`` of the candidates, the more the better.
        offsets: ``(C, 3)`` metres from the anchor.
        count: how many are wanted.
        seen: ``(C, P)`` which places that the anchor sees each candidate sees, if known.

    Returns:
        Indices of at most ``count`` candidates, best first.
    """
    lengths = np.linalg.norm(offsets, axis=-1, keepdims=True)
    directions = offsets / np.maximum(lengths, 1e-9)
    repeated = np.zeros(len(log_score))
    left = log_score.copy()
    chosen: list[int] = []
    covered = np.zeros(1 if seen is None else seen.shape[1], dtype=np.bool_)
    gain = np.zeros(len(log_score))
    for _ in range(min(count, len(log_score))):
        best = int(np.argmax(np.round(left - repeated + gain, 9)))  # the first of equals
        chosen.append(best)
        if seen is not None:
            covered = covered | seen[best]
            part = np.maximum((covered | seen).mean(axis=-1), 1e-3)
            gain = COVERAGE * np.log(part / max(float(covered.mean()), 1e-3))
        left[best] = -np.inf
        gap = np.linalg.norm(offsets - offsets[best], axis=-1) / lengths[best].clip(1e-9)
        alike = np.maximum(directions @ directions[best], 0.0) * np.exp(-gap)
        repeated = np.maximum(repeated, 1.5 * alike)
    return chosen
