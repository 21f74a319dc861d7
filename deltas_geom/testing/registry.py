"""What an invariant is, and the list of them all."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from deltas_geom.testing.planar import DepthScene, MapScene, ScoreScene
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target

Scene = PosedScene | MapScene | ScoreScene | DepthScene
"""What invariants are asked on; one kind each."""

SceneKind = Literal["posed", "named", "ties", "segments", "maps", "scores", "depths"]


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

    def offered_by(self, target: Target) -> bool:
        """Whether the target has what is needed."""
        return all(target.offers(feature) for feature in self.needs)

    def __call__(self, target: Target, scene: Scene, **choices: object) -> None:
        """Check it in the views of the scene that the target can take."""
        if isinstance(scene, PosedScene):
            scene = first_views(scene, target.max_views)
        self.check(target, scene, **choices)


INVARIANTS: dict[str, Invariant] = {}
"""Every invariant by name, in the order of the table."""


def invariant(
    *needs: str, scenes: SceneKind = "posed"
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator that puts a check into ``INVARIANTS``, under its own name.

    Args:
        *needs: features that a target must offer.
        scenes: the kind of scene it takes.
    """

    def register(check: Callable[..., None]) -> Callable[..., None]:
        INVARIANTS[check.__name__] = Invariant(check, needs, scenes)
        return check

    return register


def first_views(scene: PosedScene, count: int | None) -> PosedScene:
    """The scene with its first ``count`` views; None = all."""
    return scene._replace(
        views=scene.views.select(slice(count)), pixels=scene.pixels[..., :count, :, :]
    )
