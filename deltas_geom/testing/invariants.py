"""What is true of every right implementation, as functions that take one.

Each invariant raises ``AssertionError`` with the failing numbers. They take a
:class:`~deltas_geom.testing.targets.Target` and a scene without batch dims, whose pixels may be
noisy; further arguments have defaults, so that a test can draw them. ``INVARIANTS`` lists them
all with what they need.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from deltas_geom.fundamental import epipolar_distance, epipolar_lines
from deltas_geom.homogeneous import to_homogeneous
from deltas_geom.pixels import crop_intrinsics, resize_intrinsics
from deltas_geom.poses import camera_centers, invert_pose
from deltas_geom.projection import project
from deltas_geom.testing.scenes import IMAGE_SIZE, PosedScene, rigid
from deltas_geom.testing.targets import Target
from deltas_geom.views import PosedViews

PIXEL_TOLERANCE = 1e-6  # px
POINT_TOLERANCE = 1e-6  # m, at the few metres of the scenes


class World(NamedTuple):
    """Another frame and unit for the same world: points X become scale (R X + t).

    Attributes:
        new_from_world: ``(4, 4)`` rigid.
        scale: new units in a metre.
    """

    new_from_world: Tensor
    scale: float

    def points(self, points: Tensor) -> Tensor:
        """Points ``(N, 3)`` in the new world."""
        rotation, translation = self.new_from_world[:3, :3], self.new_from_world[:3, 3]
        return self.scale * (points @ rotation.mT + translation)

    def views(self, views: PosedViews) -> PosedViews:
        """The same cameras in the new world."""
        pose = views.cam_from_world @ invert_pose(self.new_from_world)
        unit = torch.tensor([self.scale] * 3 + [1.0], dtype=pose.dtype)
        moved = torch.cat([pose[..., :3], pose[..., 3:] * unit[:, None]], dim=-1)
        return views._replace(cam_from_world=moved)


ELSEWHERE = World(
    rigid(torch.tensor([0.5, -1.0, 2.0]).double(), torch.tensor([10.0, -5.0, 3.0]).double()), 3.0
)
"""11 m away, turned, in units of a third of a metre."""


@dataclass(frozen=True)
class Invariant:
    """An invariant and what it can be asked of.

    Attributes:
        check: the function; its docstring's first sentence is the theorem.
        needs: features that :meth:`Target.offers` must have.
        scenes: "posed" (well posed, maybe noisy), "named" (of ``DEGENERATE_SCENES``), or "ties"
            (equal singular values: ``right_angle``, ``ring``).
    """

    check: Callable[..., None]
    needs: tuple[str, ...]
    scenes: Literal["posed", "named", "ties"]

    @property
    def theorem(self) -> str:
        """One sentence."""
        return " ".join((self.check.__doc__ or "").split("\n\n")[0].split())

    def offered_by(self, target: Target) -> bool:
        """Whether the target has what is needed."""
        return all(target.offers(feature) for feature in self.needs)

    def __call__(self, target: Target, scene: PosedScene, **choices: object) -> None:
        """Check it in the views of the scene that the target can take."""
        self.check(target, first_views(scene, target.max_views), **choices)


INVARIANTS: dict[str, Invariant] = {}
"""Every invariant by name, in the order of the table."""


def first_views(scene: PosedScene, count: int | None) -> PosedScene:
    """The scene with its first ``count`` views; None = all."""
    return scene._replace(
        views=scene.views.select(slice(count)), pixels=scene.pixels[..., :count, :, :]
    )


def _invariant(
    *needs: str, scenes: Literal["posed", "named", "ties"] = "posed"
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    def register(check: Callable[..., None]) -> Callable[..., None]:
        INVARIANTS[check.__name__] = Invariant(check, needs, scenes)
        return check

    return register


# Projection.


@_invariant("project")
def pixels_are_those_of_the_camera_equations(target: Target, scene: PosedScene) -> None:
    """A pixel is K [R | t] X divided by its last coordinate, skew included."""
    homogeneous = to_homogeneous(scene.points) @ scene.views.proj.mT
    wanted = homogeneous[..., :2] / homogeneous[..., 2:]
    _assert_near(_pixels(target, scene.views, scene.points), wanted, PIXEL_TOLERANCE, "px")


@_invariant("project")
def pixels_do_not_know_the_worlds_frame(
    target: Target, scene: PosedScene, *, world: World = ELSEWHERE
) -> None:
    """Pixels stay when cameras and points are moved, turned and scaled together."""
    moved = _pixels(target, world.views(scene.views), world.points(scene.points))
    _assert_near(moved, _pixels(target, scene.views, scene.points), PIXEL_TOLERANCE, "px")


@_invariant("project")
def pixels_follow_a_crop_and_a_resize(target: Target, scene: PosedScene) -> None:
    """A camera of the cropped and resized image sees points where their pixels went."""
    cut = _cut(scene.views, new_size=(240, 160))
    seen = _pixels(target, scene.views._replace(K=cut @ scene.views.K), scene.points)
    wanted = _transformed(cut, _pixels(target, scene.views, scene.points))
    _assert_near(seen, wanted, PIXEL_TOLERANCE, "px")


@_invariant("project", scenes="named")
def pixels_are_finite(target: Target, scene: PosedScene) -> None:
    """Pixels of finite points are finite, even behind a camera or in its very centre."""
    points = torch.cat([scene.points, camera_centers(scene.views.cam_from_world)])
    _assert_finite(_pixels(target, scene.views, points[points.isfinite().all(dim=-1)]), "pixels")


# Fundamental matrices. They have no scale: their lines are compared, in pixels.


@_invariant("fundamental")
def a_match_lies_on_its_epipolar_line(target: Target, scene: PosedScene) -> None:
    """x1^T F x0 = 0 for the pixels x0, x1 of a point, and there is a line."""
    first, second = project(scene.views, scene.points).pixels[:2]
    found = _fundamental(target, scene.views)
    offset = epipolar_distance(found, first, second)
    _assert_near(offset, torch.zeros_like(offset), PIXEL_TOLERANCE, "px")
    length = epipolar_lines(found, first)[:, :2].norm(dim=-1)
    _assert_near(length, torch.ones_like(length), 1e-6, "(length of a line's normal)")


@_invariant("fundamental")
def the_fundamental_matrix_back_is_the_transpose(target: Target, scene: PosedScene) -> None:
    """F from view 1 to view 0 is the transpose of F from view 0 to view 1."""
    back = _fundamental(target, scene.views.select([1, 0]))
    _assert_same_lines(back, _fundamental(target, scene.views).mT, scene.pixels[1])


@_invariant("fundamental")
def the_fundamental_matrix_does_not_know_the_worlds_frame(
    target: Target, scene: PosedScene, *, world: World = ELSEWHERE
) -> None:
    """F stays, up to scale, when the cameras are moved, turned and scaled together."""
    moved = _fundamental(target, world.views(scene.views))
    _assert_same_lines(moved, _fundamental(target, scene.views), scene.pixels[0])


@_invariant("fundamental")
def the_fundamental_matrix_follows_a_crop_and_a_resize(target: Target, scene: PosedScene) -> None:
    """F of cropped and resized images is A1^-T F A0^-1, A the change of each view's pixels."""
    cut = _cut(scene.views, new_size=(240, 160))
    back = torch.linalg.inv(cut)
    wanted = back[1].mT @ _fundamental(target, scene.views) @ back[0]
    found = _fundamental(target, scene.views._replace(K=cut @ scene.views.K))
    _assert_same_lines(found, wanted, _transformed(cut, scene.pixels)[0])


@_invariant("fundamental", scenes="named")
def the_fundamental_matrix_is_finite(target: Target, scene: PosedScene) -> None:
    """F is finite wherever the cameras stand."""
    _assert_finite(_fundamental(target, scene.views), "F")


# Triangulation. With weights where the target heeds them.


@_invariant("triangulate")
def points_are_exact_without_noise(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """The pixels of a point give the point."""
    exact = scene._replace(pixels=project(scene.views, scene.points).pixels)
    found = _points(target, exact, _weights(target, scene, weights))
    _assert_near(found, scene.points, POINT_TOLERANCE, "m")


@_invariant("triangulate")
def points_move_with_the_world(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None, world: World = ELSEWHERE
) -> None:
    """Where cameras are moved, turned and scaled, the points of noisy pixels go with them."""
    weights = _weights(target, scene, weights)
    moved = _points(target, scene._replace(views=world.views(scene.views)), weights)
    back = World(invert_pose(world.new_from_world), 1.0).points(moved / world.scale)
    _assert_near(back, _points(target, scene, weights), POINT_TOLERANCE, "m")


@_invariant("triangulate")
def points_do_not_know_of_a_crop_and_a_resize(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """Points stay when each image is cropped anywhere and all are halved."""
    weights = _weights(target, scene, weights)
    cut = _cut(scene.views, new_size=(240, 320))
    views = scene.views._replace(K=cut @ scene.views.K)
    halved = PosedScene(views, scene.points, _transformed(cut, scene.pixels))
    _assert_near(
        _points(target, halved, weights), _points(target, scene, weights), POINT_TOLERANCE, "m"
    )


@_invariant("triangulate")
def points_do_not_know_the_order_of_views(
    target: Target,
    scene: PosedScene,
    *,
    weights: Tensor | None = None,
    order: list[int] | None = None,
) -> None:
    """Points stay when the views are permuted (here: reversed)."""
    weights = _weights(target, scene, weights)
    order = order or list(reversed(range(scene.views.num_views)))
    permuted = scene._replace(views=scene.views.select(order), pixels=scene.pixels[order])
    found = _points(target, permuted, None if weights is None else weights[order])
    _assert_near(found, _points(target, scene, weights), POINT_TOLERANCE, "m")


@_invariant("triangulate")
def many_points_are_solved_as_each_alone(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """A batch of points gives what the points give one at a time."""
    weights = _weights(target, scene, weights)
    alone = []
    for point in range(scene.points.shape[0]):
        one = slice(point, point + 1)
        single = scene._replace(pixels=scene.pixels[:, one])
        alone.append(_points(target, single, None if weights is None else weights[:, one]))
    _assert_near(_points(target, scene, weights), torch.cat(alone), POINT_TOLERANCE, "m")


@_invariant("weights")
def only_the_ratios_of_weights_count(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None, factor: float = 7.0
) -> None:
    """Points stay when all weights are multiplied by one factor."""
    weights = _weights(target, scene, weights)
    assert weights is not None
    found = _points(target, scene, factor * weights)
    _assert_near(found, _points(target, scene, weights), POINT_TOLERANCE, "m")


@_invariant("weights", "many views")
def a_view_of_weight_0_is_a_view_removed(
    target: Target,
    scene: PosedScene,
    *,
    weights: Tensor | None = None,
    view: int = -1,
    spoil: float = 100.0,
) -> None:
    """A view of weight 0 changes nothing, wherever its pixels lie (moved by ``spoil`` px).

    The scene has three views or more.
    """
    weights = _weights(target, scene, weights)
    assert weights is not None
    rest = [other for other in range(scene.views.num_views) if other != view % weights.shape[0]]
    removed = scene._replace(views=scene.views.select(rest), pixels=scene.pixels[rest])
    spoiled, without = scene.pixels.clone(), weights.clone()
    spoiled[view] += spoil
    without[view] = 0
    found = _points(target, scene._replace(pixels=spoiled), without)
    _assert_near(found, _points(target, removed, weights[rest]), POINT_TOLERANCE, "m")


@_invariant("weights", "many views")
def a_doubled_view_is_a_doubled_squared_weight(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """A view given twice counts as once with its weights times the square root of 2."""
    pair = first_views(scene, 2)
    weights = _weights(target, pair, None if weights is None else weights[:2])
    assert weights is not None
    twice = [0, 1, 1]
    doubled = pair._replace(views=pair.views.select(twice), pixels=pair.pixels[twice])
    heavier = weights * torch.tensor([1.0, 2**0.5], dtype=weights.dtype)[:, None]
    found = _points(target, doubled, weights[twice])
    _assert_near(found, _points(target, pair, heavier), POINT_TOLERANCE, "m")


@_invariant("gradients")
def gradients_are_finite_differences(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """The gradient by pixels, cameras and weights is finite and that of finite differences."""
    weights = _weights(target, scene, weights)
    inputs = [scene.views.proj, scene.pixels] + ([] if weights is None else [weights])

    def loss(*values: Tensor) -> Tensor:
        assert target.triangulate is not None
        found = target.triangulate(values[0], values[1], values[2] if weights is not None else None)
        # Different factors, so that no two errors cancel.
        return (found * torch.linspace(1, 2, found.numel()).to(found).reshape(found.shape)).sum()

    for value, found, name in zip(
        inputs, _gradients(loss, inputs), ("proj", "pixels", "weights"), strict=False
    ):
        # Relative steps, so that entries of all units get an effect in metres.
        step = 1e-5 * value.abs().clamp(min=1)
        wanted = _differences(loss, inputs, value, step)
        size = step / 1e-5
        tolerance = 1e-5 + 1e-4 * float((wanted * size).abs().max())
        _assert_near(found * size, wanted * size, tolerance, f"m (gradient by {name}, relative)")


@_invariant("gradients", scenes="ties")
def gradients_are_finite_differences_at_ties(target: Target, scene: PosedScene) -> None:
    """The gradient is right where singular values are equal: at 90 degrees and on a ring."""
    # Unequal weights would break the tie.
    equal = torch.ones_like(scene.pixels[..., 0])
    gradients_are_finite_differences(target, scene, weights=equal)


@_invariant("triangulate", scenes="named")
def points_are_finite(target: Target, scene: PosedScene) -> None:
    """Points are finite, whatever the cameras and pixels."""
    equal = _weights(target, scene, torch.ones_like(scene.pixels[..., 0]))
    _assert_finite(_points(target, scene, equal), "points")


@_invariant("gradients", scenes="named")
def gradients_are_finite(target: Target, scene: PosedScene) -> None:
    """The gradient of the points that are finite is finite, whatever the cameras and pixels."""
    equal = _weights(target, scene, torch.ones_like(scene.pixels[..., 0]))

    def loss(proj: Tensor, pixels: Tensor) -> Tensor:
        found = _points(target, scene._replace(pixels=pixels), equal, proj=proj)
        return found[found.isfinite().all(dim=-1)].sum()

    for name, gradient in zip(
        ("proj", "pixels"), _gradients(loss, [scene.views.proj, scene.pixels]), strict=True
    ):
        _assert_finite(gradient, f"gradient by {name}")


# What the target says.


def _pixels(target: Target, views: PosedViews, points: Tensor) -> Tensor:
    assert target.project is not None
    return target.project(views.K, views.cam_from_world, points)


def _fundamental(target: Target, views: PosedViews) -> Tensor:
    assert target.fundamental is not None
    pair = views.select(slice(2))
    return target.fundamental(pair.K, pair.cam_from_world)


def _points(
    target: Target, scene: PosedScene, weights: Tensor | None, *, proj: Tensor | None = None
) -> Tensor:
    assert target.triangulate is not None
    return target.triangulate(scene.views.proj if proj is None else proj, scene.pixels, weights)


def _weights(target: Target, scene: PosedScene, weights: Tensor | None) -> Tensor | None:
    """``(V, N)``, unequal unless given; None for a target that does not heed them."""
    if not target.weighted:
        return None
    if weights is not None:
        return weights[: scene.views.num_views]
    views, points = scene.pixels.shape[:2]
    pattern = torch.arange(views)[:, None] + torch.arange(points)
    return 1 / (1 + pattern % 3).to(scene.pixels.dtype)


# Helpers of the checks.


def _cut(views: PosedViews, *, new_size: tuple[int, int]) -> Tensor:
    """How pixels change, ``(V, 3, 3)``: each view cropped elsewhere, all resized alike."""
    identity = torch.eye(3, dtype=views.K.dtype)
    cropped = [
        crop_intrinsics(identity, left=3.0 + 7 * view, top=11.0 - 5 * view)
        for view in range(views.num_views)
    ]
    return resize_intrinsics(torch.stack(cropped), old_size=IMAGE_SIZE, new_size=new_size)


def _transformed(change: Tensor, pixels: Tensor) -> Tensor:
    return (to_homogeneous(pixels) @ change.mT)[..., :2]


def _gradients(loss: Callable[..., Tensor], inputs: list[Tensor]) -> list[Tensor]:
    leaves = [value.detach().clone().requires_grad_() for value in inputs]
    total = loss(*leaves)
    if not total.requires_grad:
        return [torch.zeros_like(value) for value in inputs]
    found = torch.autograd.grad(total, leaves, allow_unused=True)
    pairs = zip(inputs, found, strict=True)
    return [torch.zeros_like(value) if grad is None else grad for value, grad in pairs]


def _differences(
    loss: Callable[..., Tensor], inputs: list[Tensor], value: Tensor, step: Tensor
) -> Tensor:
    """Central differences by each entry of ``value``, which is one of the inputs."""
    found = torch.zeros_like(value)
    for index in torch.cartesian_prod(*(torch.arange(size) for size in value.shape)).tolist():
        change = torch.zeros_like(value)
        change[tuple(index)] = step[tuple(index)]
        ahead, behind = (
            loss(*(other + sign * change if other is value else other for other in inputs))
            for sign in (1, -1)
        )
        found[tuple(index)] = (ahead - behind) / (2 * step[tuple(index)])
    return found


def _assert_near(found: Tensor, wanted: Tensor, tolerance: float, unit: str) -> None:
    error = (found.detach() - wanted.detach()).abs()
    bad = ~(error <= tolerance)  # NaN is bad
    if bool(bad.any()):
        worst = int(torch.where(bad, error.nan_to_num(torch.inf), -1.0).argmax())
        index = tuple(int(i) for i in torch.unravel_index(torch.tensor(worst), error.shape))
        raise AssertionError(
            f"{float(found[index]):.9g} instead of {float(wanted[index]):.9g} at "
            f"{list(index)}: off by {float(error[index]):.2g}, allowed {tolerance:.2g} {unit}"
        )


def _assert_same_lines(found: Tensor, wanted: Tensor, pixels: Tensor) -> None:
    """Both matrices draw the same lines of ``pixels (N, 2)``, measured at the image's corners."""
    height, width = IMAGE_SIZE
    corners = torch.tensor([[0, 0], [width, 0], [0, height], [width, height]]).to(pixels)
    ours, theirs = epipolar_lines(found, pixels), epipolar_lines(wanted, pixels)
    sign = (ours[:, :2] * theirs[:, :2]).sum(dim=-1, keepdim=True).sign()
    found, wanted = (line @ to_homogeneous(corners).mT for line in (sign * ours, theirs))
    _assert_near(found, wanted, PIXEL_TOLERANCE, "px (of a corner from a line)")


def _assert_finite(found: Tensor, name: str) -> None:
    bad = ~found.detach().isfinite()
    if bool(bad.any()):
        index = bad.nonzero()[0].tolist()
        raise AssertionError(f"{name} {index} is {float(found[tuple(index)])}")
