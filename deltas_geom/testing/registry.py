"""What an invariant is, and the list of them all."""

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import wraps
from typing import Literal

from deltas_geom.testing.agreement import allowing
from deltas_geom.testing.planar import DepthScene, MapScene, ScoreScene
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target, fields_of

Scene = PosedScene | MapScene | ScoreScene | DepthScene
"""What invariants are asked on; one kind each."""

SceneKind = Literal["posed", "named", "ties", "segments", "maps", "scores", "depths"]
_PLANAR: dict[str, type[Scene]] = {"maps": MapScene, "scores": ScoreScene, "depths": DepthScene}


@dataclass(frozen=True)
class Invariant:
    """An invariant and what it can be asked of.

    Attributes:
        check: the function; its docstring's first sentence is the theorem.
        needs: features that :meth:`Target.offers` must have.
        scenes: "posed" (well posed, maybe noisy), "named" (of ``DEGENERATE_SCENES``), "ties"
            (equal singular values: ``right_angle``, ``ring``), "segments" (two views of either
            kind), or one without cameras: "maps", "scores", "depths".
    """

    check: Callable[..., None]
    needs: tuple[str, ...]
    scenes: SceneKind

    @property
    def theorem(self) -> str:
        """One sentence."""
        return " ".join((self.check.__doc__ or "").split("\n\n")[0].split())

    @property
    def least_views(self) -> int:
        """How many views a scene must have: 1 for what a camera does alone, else 2 or 3."""
        if "many views" in self.needs:
            return 3
        return 1 if self.needs[0] in ("project", "unproject", "rays") else 2

    def offered_by(self, target: Target) -> bool:
        """Whether the target has what is needed."""
        return all(target.offers(feature) for feature in self.needs)

    def __call__(self, target: Target, scene: Scene, **choices: object) -> None:
        """Check it in the views of the scene that the target can take.

        Raises:
            AssertionError: the invariant does not hold, with the failing numbers; or an answer
                is of another shape or dtype, is not the same twice, or an argument was changed.
            TypeError: a scene of another kind, or a function of the target returns no tensor.
            ValueError: the target does not offer what is needed, or the scene has too few views,
                batch dims, or other pixels than views and points.
        """
        name = self.check.__name__
        if not isinstance(target, Target):
            raise TypeError(f"{name} takes a Target, got {type(target).__name__}")
        for feature in self.needs:
            if not target.offers(feature):
                raise ValueError(f"{name} needs {fields_of(feature)}: {target.name} lacks it")
        kind = _PLANAR.get(self.scenes, PosedScene)
        if not isinstance(scene, kind):
            raise TypeError(f"{name} takes a {kind.__name__}, got {type(scene).__name__}")
        if isinstance(scene, PosedScene):
            _check_scene(name, scene)
            views = scene.views.num_views
            if views < self.least_views:
                raise ValueError(f"{name} needs a scene of {self.least_views} views, got {views}")
            scene = first_views(scene, target.max_views)
        remarks: list[str] = []
        try:
            with allowing(target.tolerance):
                self.check(target.checked(remarks), scene, **choices)
        except Exception as error:
            # Notes, so that a raw traceback or hypothesis says, too, what was asked of what.
            for remark in remarks:
                error.add_note(remark)
            error.add_note(f"{target.name}: {self.theorem} ({name})\n{scene.sketch()}")
            raise


def _check_scene(name: str, scene: PosedScene) -> None:
    views, points, pixels = scene
    count = points.shape[0] if points.dim() == 2 else 0
    wanted = (views.num_views, count, 2)
    if points.dim() != 2 or pixels.shape != wanted or views.K.dim() != 3:
        raise ValueError(
            f"{name} takes a scene without batch dims: points (N, 3), pixels (V, N, 2), "
            f"K (V, 3, 3), got {tuple(points.shape)}, {tuple(pixels.shape)}, "
            f"{tuple(views.K.shape)}"
        )


class _ByName(dict[str, Invariant]):
    def __missing__(self, name: str) -> Invariant:
        near = get_close_matches(name, self, n=1, cutoff=0.0)
        raise KeyError(f"no invariant {name!r}: did you mean {near[0]!r}?")


INVARIANTS: dict[str, Invariant] = _ByName()
"""Every invariant by name, in the order of the table."""


def invariant(
    *needs: str, scenes: SceneKind = "posed"
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator that puts a check into ``INVARIANTS``, under its own name, and asks through it.

    Args:
        *needs: features that a target must offer.
        scenes: the kind of scene it takes.
    """

    def register(check: Callable[..., None]) -> Callable[..., None]:
        made = INVARIANTS[check.__name__] = Invariant(check, needs, scenes)

        @wraps(check)
        def ask(target: Target, scene: Scene, **choices: object) -> None:
            made(target, scene, **choices)

        return ask

    return register


def first_views(scene: PosedScene, count: int | None) -> PosedScene:
    """The scene with its first ``count`` views; None = all."""
    return scene._replace(
        views=scene.views.select(slice(count)), pixels=scene.pixels[..., :count, :, :]
    )
