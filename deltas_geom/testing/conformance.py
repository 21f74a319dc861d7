"""The conformance table: every invariant, every target, and the smallest scene that fails."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Literal, NamedTuple

import torch

from deltas_geom.testing.invariants import INVARIANTS, Invariant, first_views
from deltas_geom.testing.scenes import (
    DEGENERATE_SCENES,
    PosedScene,
    default_intrinsics,
    right_angle,
    rigid,
    ring,
    scene_from,
)
from deltas_geom.testing.targets import Target
from deltas_geom.views import PosedViews


class Outcome(NamedTuple):
    """What became of one invariant in one target.

    Attributes:
        invariant: its name in ``INVARIANTS``.
        target: the target's name.
        result: "pass", "FAIL", or "-" if the target does not offer what it is about.
        example: the smallest failing scene and its numbers; empty unless it failed.
    """

    invariant: str
    target: str
    result: Literal["pass", "FAIL", "-"]
    example: str = ""


def seeded_scene(
    seed: int, *, num_views: int = 2, num_points: int = 1, noise: float = 0.0, skew: float = 0.0
) -> PosedScene:
    """A well-posed scene in short numbers, the same on every machine; float64.

    Cameras look ahead from 25 cm beside each other, points lie around 3.5 m ahead.

    Args:
        seed: which one; 0 leaves the cameras unturned.
        num_views: V.
        num_points: N.
        noise: largest error of a pixel's coordinate, px.
        skew: of all cameras, px.

    Example:
        >>> seeded_scene(0).views.cam_from_world[1, :3, 3]
        tensor([-0.2500,  0.0000,  0.0000], dtype=torch.float64)
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int, within: float) -> torch.Tensor:
        steps = torch.randint(-64, 65, shape, generator=generator)
        return steps.double() * (within / 64)

    points = draw(num_points, 3, within=1.0) + torch.tensor([0, 0, 3.5])
    turn = draw(num_views, 3, within=0.0 if seed == 0 else 0.25)  # rad
    shift = torch.zeros(num_views, 3, dtype=torch.float64)  # m
    shift[:, 0] = -0.25 * torch.arange(num_views)
    K = default_intrinsics().repeat(num_views, 1, 1)
    K[:, 0, 1] = skew
    scene = scene_from(PosedViews(K, rigid(turn, shift)), points)
    return scene._replace(pixels=scene.pixels + draw(num_views, num_points, 2, within=noise))


_SEEDED = (
    partial(seeded_scene, 0),
    partial(seeded_scene, 0, noise=1.0),
    partial(seeded_scene, 0, noise=1.0, skew=5.0),
    partial(seeded_scene, 1),
    partial(seeded_scene, 1, noise=1.0),
    partial(seeded_scene, 0, num_views=3, noise=1.0),
    partial(seeded_scene, 2, num_views=3, num_points=3, noise=1.0, skew=5.0),
    partial(seeded_scene, 3, num_views=5, num_points=4, noise=1.0),
)


def scenes_for(invariant: Invariant) -> list[partial[PosedScene]]:
    """The fixed scenes of an invariant, smallest first, as the calls that make them."""
    if invariant.scenes == "posed":
        needed = 3 if "many views" in invariant.needs else 2
        return [make for make in _SEEDED if make.keywords.get("num_views", 2) >= needed]
    if invariant.scenes == "ties":
        return [partial(make, dtype=torch.float64) for make in (right_angle, ring)]
    dtypes = (torch.float64, torch.float32)
    return [partial(make, dtype=dtype) for make in DEGENERATE_SCENES.values() for dtype in dtypes]


def check(name: str, target: Target) -> Outcome:
    """Ask one target for one invariant, on its scenes, smallest first."""
    invariant = INVARIANTS[name]
    if not invariant.offered_by(target):
        return Outcome(name, target.name, "-")
    for make in scenes_for(invariant):
        scene = make()
        try:
            invariant(target, scene)
        except Exception as error:  # whatever another's code raises is its failure
            kind = "" if isinstance(error, AssertionError) else f"{type(error).__name__}: "
            seen = first_views(scene, target.max_views)
            example = f"{_call(make)}: {kind}{error}\n{_sketch(seen)}"
            return Outcome(name, target.name, "FAIL", example)
    return Outcome(name, target.name, "pass")


def conformance(targets: Iterable[Target]) -> list[Outcome]:
    """Ask every target for every invariant.

    Example:
        >>> from deltas_geom.testing.targets import kornia
        >>> outcomes = conformance([kornia("eigh")])
        >>> [outcome.invariant for outcome in outcomes if outcome.result == "FAIL"]
        ['points_move_with_the_world', ...]
    """
    return [check(name, target) for target in targets for name in INVARIANTS]


def table(outcomes: Sequence[Outcome]) -> str:
    """A row an invariant, a column a target, and the failing examples below."""
    targets = list(dict.fromkeys(outcome.target for outcome in outcomes))
    results = {(outcome.invariant, outcome.target): outcome.result for outcome in outcomes}
    names = list(dict.fromkeys(outcome.invariant for outcome in outcomes))
    width = max((len(name) for name in names), default=0)
    lines = ["  ".join([" " * width, *targets])]
    for name in names:
        cells = [results[name, target].center(len(target)) for target in targets]
        lines.append("  ".join([name.replace("_", " ").ljust(width), *cells]).rstrip())
    for outcome in outcomes:
        if outcome.result == "FAIL":
            theorem = INVARIANTS[outcome.invariant].theorem
            lines += ["", f"{outcome.target}: {theorem}", _indented(outcome.example)]
    return "\n".join(lines)


def _call(make: partial[PosedScene]) -> str:
    """The call as one would write it."""
    arguments = [*map(str, make.args), *(f"{key}={value}" for key, value in make.keywords.items())]
    return f"{make.func.__name__}({', '.join(arguments)})"


def _sketch(scene: PosedScene) -> str:
    """The first point and where it is seen: enough to draw the scene."""
    seen = ", ".join(_numbers(view[0]) for view in scene.pixels)
    more = scene.points.shape[0] - 1
    others = f" and {more} more" if more else ""
    point = _numbers(scene.points[0])
    return f"{scene.views.num_views} views, point {point} m{others}, seen at {seen} px"


def _numbers(vector: torch.Tensor) -> str:
    return "(" + ", ".join(f"{value:.7g}" for value in vector.tolist()) + ")"


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.splitlines())
