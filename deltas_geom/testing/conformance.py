"""The conformance table: every invariant, every target, and the smallest scene that fails."""

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import cache, partial
from typing import Any, Literal, NamedTuple

from deltas_geom.testing.fixed_scenes import scenes_for, seeded_scene
from deltas_geom.testing.invariants import INVARIANTS, first_views
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target

__all__ = ["Outcome", "check", "conformance", "scenes_for", "seeded_scene", "table"]


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


def check(name: str, target: Target) -> Outcome:
    """Ask one target for one invariant, on its scenes, smallest first."""
    invariant = INVARIANTS[name]
    if not invariant.offered_by(target):
        return Outcome(name, target.name, "-")
    for make in scenes_for(invariant):
        scene = _made(make)
        try:
            invariant(target, scene)
        except Exception as error:  # whatever another's code raises is its failure
            kind = "" if isinstance(error, AssertionError) else f"{type(error).__name__}: "
            if isinstance(scene, PosedScene):
                scene = first_views(scene, target.max_views)
            # The last note is the theorem and the sketch, which the table has elsewhere.
            remarks = getattr(error, "__notes__", [])[:-1]
            example = "\n".join([f"{_call(make)}: {kind}{error}", *remarks, scene.sketch()])
            return Outcome(name, target.name, "FAIL", example)
    return Outcome(name, target.name, "pass")


@cache
def _made(make: partial[Any]) -> Any:
    """A scene, made once: whoever is asked about it is given copies."""
    return make()


def conformance(targets: Iterable[Target]) -> list[Outcome]:
    """Ask every target for every invariant.

    Raises:
        TypeError: what is asked is no target, or is not a list of them.
        ValueError: two targets have one name.

    Example:
        >>> from deltas_geom.testing.targets import kornia
        >>> outcomes = conformance([kornia("eigh")])
        >>> [outcome.invariant for outcome in outcomes if outcome.result == "FAIL"]
        ['points_move_with_the_world', ...]
    """
    if isinstance(targets, Target):
        raise TypeError("targets must be a list of Target, got one: use [target]")
    targets = list(targets)
    for target in targets:
        if not isinstance(target, Target):
            kind = type(target).__name__
            raise TypeError(
                f'targets must be a list of Target, got a {kind} in it: use Target("mine", ...)'
            )
    for name, count in Counter(target.name for target in targets).items():
        if count > 1:
            raise ValueError(f"{count} targets are named {name!r}: give each its own name")
    return [check(name, target) for target in targets for name in INVARIANTS]


def table(outcomes: Sequence[Outcome]) -> str:
    """A row an invariant, a column a target, and the failing examples below.

    A cell is blank where a target was not asked.

    Raises:
        ValueError: two outcomes are of the same invariant and target.
    """
    cells_of = Counter((outcome.invariant, outcome.target) for outcome in outcomes)
    for (name, target), count in cells_of.items():
        if count > 1:
            raise ValueError(f"{count} outcomes of {name} are of targets named {target!r}")
    targets = list(dict.fromkeys(outcome.target for outcome in outcomes))
    results = {(outcome.invariant, outcome.target): outcome.result for outcome in outcomes}
    names = list(dict.fromkeys(outcome.invariant for outcome in outcomes))
    width = max((len(name) for name in names), default=0)
    lines = ["  ".join([" " * width, *targets])]
    for name in names:
        cells = [results.get((name, target), "").center(len(target)) for target in targets]
        lines.append("  ".join([name.replace("_", " ").ljust(width), *cells]).rstrip())
    failed: dict[tuple[str, str], list[str]] = {}
    for outcome in outcomes:
        if outcome.result == "FAIL":
            failed.setdefault((outcome.invariant, outcome.example), []).append(outcome.target)
    for (name, example), who in failed.items():
        lines += ["", f"{', '.join(who)}: {INVARIANTS[name].theorem} ({name})", _indented(example)]
    return "\n".join(lines)


def _call(make: partial[Any]) -> str:
    """The call as one would write it."""
    arguments = [*map(repr, make.args), *(f"{key}={value}" for key, value in make.keywords.items())]
    return f"{make.func.__name__}({', '.join(arguments)})"


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.splitlines())
