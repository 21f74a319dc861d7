"""Cameras as they should have been, if a cause were the one."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.poses import invert_pose
from deltas_geom.diagnosis.causes import Cause
from deltas_geom.diagnosis.evidence import Evidence, inverse_up_to_scale, residuals

COMMON_SIZES = (0.5, 2.0, 0.25, 4.0, 1 / 3, 3.0, 2 / 3, 1.5)
COMMON_UNITS = (1000.0, 0.001, 100.0, 0.01, 10.0, 0.1, 0.3048, 1 / 0.3048, 0.0254, 1 / 0.0254)
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], device="cpu").double())
_SWAP = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]], device="cpu").double()
_SIZES = sorted({*COMMON_SIZES, *(2 ** (step / 8) for step in range(-16, 17) if step)})
_FINEST = 1e-4  # relative, of factors that are searched
_MATCHES_AT_ONCE = 30_000  # of all cameras tried together: 1 MB a tensor of both directions


class Hypothesis(NamedTuple):
    """One cause and the cameras without it.

    Attributes:
        cause: what would have been wrong.
        cameras: those concerned; empty = all.
        factor: what K or the translation was to be multiplied by, or the shift of pixels in px.
        K: ``(V, 3, 3)`` mended.
        pose: ``(V, 4, 4)`` mended cam_from_world.
    """

    cause: Cause
    cameras: tuple[int, ...]
    factor: float | None
    K: Tensor
    pose: Tensor


Cameras = tuple[Tensor, Tensor]  # K and cam_from_world
Mend = Callable[[Tensor, Tensor], Cameras]

MENDS: dict[Cause, Mend] = {
    Cause.POSES_INVERTED: lambda K, pose: (K, invert_pose(pose)),
    Cause.OPENGL_WORLD_FROM_CAM: lambda K, pose: (K, _FLIP @ invert_pose(pose)),
    Cause.OPENGL_AXES: lambda K, pose: (K, _FLIP @ pose),
    Cause.ROTATIONS_TRANSPOSED: lambda K, pose: (K, _joined(pose[:, :3, :3].mT, pose[:, :3, 3:])),
    # The centre is -R^T t, and stays: so t becomes R^T R^T t.
    Cause.ROTATIONS_INVERTED: lambda K, pose: (
        K,
        _joined(pose[:, :3, :3].mT, pose[:, :3, :3].mT @ pose[:, :3, :3].mT @ pose[:, :3, 3:]),
    ),
    Cause.CENTERS_AS_TRANSLATIONS: lambda K, pose: (
        K,
        _joined(pose[:, :3, :3], -pose[:, :3, :3] @ pose[:, :3, 3:]),
    ),
    Cause.K_TRANSPOSED: lambda K, pose: (K.mT, pose),
    # A camera that sees (row, column) is one whose first two rows are exchanged.
    Cause.AXES_SWAPPED: lambda K, pose: (_SWAP @ K, pose),
}
"""What mends each cause that needs no search, in all of the cameras it is given."""


def resized(K: Tensor, factor: float) -> Tensor:
    """K of images ``factor`` times as large."""
    half = K.new_tensor([[factor, 0, factor / 2 - 0.5], [0, factor, factor / 2 - 0.5], [0, 0, 1]])
    return half @ K


def zoomed(K: Tensor, factor: float) -> Tensor:
    """K with focal lengths ``factor`` times as long, and the centre where it is."""
    changed = K.clone()
    changed[:, :2, :2] *= factor
    return changed


def pixels_at(slopes: Tensor, K: Tensor) -> Tensor:
    """``(V, N, 2)`` pixels of normalised ones."""
    return (to_homogeneous(slopes) @ K.mT)[..., :2]


def of_all(K: Tensor, pose: Tensor, evidence: Evidence) -> Iterator[Hypothesis]:
    """Causes that concern all cameras."""
    yield from _of(K, pose, evidence, slice(None))
    zoom = best_size(K, pose, evidence, slice(None), zoomed)
    yield Hypothesis(Cause.FOCAL_LENGTH, (), zoom, zoomed(K, zoom), pose)
    for shift in (-0.5, 0.5):
        yield Hypothesis(Cause.HALF_A_PIXEL, (), shift, shifted(K, -shift), pose)


def of_one(K: Tensor, pose: Tensor, evidence: Evidence, camera: int) -> Iterator[Hypothesis]:
    """Causes that concern one camera alone; ``evidence`` is that of its pairs."""
    yield from _of(K, pose, evidence, slice(camera, camera + 1), camera)
    unit = best_unit(K, pose, evidence, camera)
    yield Hypothesis(Cause.UNIT_OF_TRANSLATION, (camera,), unit, K, with_unit(pose, camera, unit))


def _of(
    K: Tensor, pose: Tensor, evidence: Evidence, chosen: slice, *cameras: int
) -> Iterator[Hypothesis]:
    """Causes that may concern all cameras or one."""
    for cause, mend in MENDS.items():
        # The transpose of a K with a centre is no camera: it maps all pixels next to one.
        if cause is Cause.K_TRANSPOSED and bool((K[chosen, :2, 2] != 0).any()):
            continue
        mended = mend(K[chosen], pose[chosen])
        yield Hypothesis(cause, cameras, None, *replaced(K, pose, chosen, *mended))
    size = best_size(K, pose, evidence, chosen)
    other = replaced(K, pose, chosen, resized(K[chosen], size), pose[chosen])
    yield Hypothesis(Cause.K_OF_OTHER_SIZE, cameras, size, *other)


def exchanged(K: Tensor, pose: Tensor, one: int, other: int) -> Hypothesis:
    """Pixels of two views exchanged, which is as well two cameras exchanged."""
    order = torch.arange(len(K), device=K.device)
    order[[one, other]] = order[[other, one]]
    return Hypothesis(Cause.VIEWS_SWAPPED, (one, other), None, K[order], pose[order])


def best_size(
    K: Tensor,
    pose: Tensor,
    evidence: Evidence,
    chosen: slice,
    by: Callable[[Tensor, float], Tensor] = resized,
) -> float:
    """Factor of the chosen cameras' K, or of their focal lengths, with the least residuals."""

    def cameras(factor: float) -> Cameras:
        return replaced(K, pose, chosen, by(K[chosen], factor), pose[chosen])

    return _searched(cameras, evidence, _SIZES, COMMON_SIZES, step=2 ** (1 / 8))


def best_unit(K: Tensor, pose: Tensor, evidence: Evidence, camera: int) -> float:
    """Factor of a camera's translation with the least residuals.

    x1^T F x0 = 0 is linear in it: every match votes, the more the longer its epipolar line moves.
    """

    def cameras(factor: float) -> Cameras:
        return K, with_unit(pose, camera, factor)

    without, once = (_epipolar(evidence, K, with_unit(pose, camera, unit)) for unit in (0.0, 1.0))
    change = once - without
    votes = -without / change
    good = votes.isfinite() & (votes > 0)
    starts = [*COMMON_UNITS]
    if bool(good.any()):
        # The middle vote, and those of single pairs, as the wrong matches of some may agree.
        for some in (
            votes[good],
            *(v[g] for v, g in zip(votes, good, strict=True) if bool(g.any())),
        ):
            starts.append(float(some.median()))
    return _searched(cameras, evidence, starts, COMMON_UNITS, step=1.2)


def with_unit(pose: Tensor, camera: int, unit: float) -> Tensor:
    """Poses with the translation of one multiplied."""
    changed = pose.clone()
    changed[camera, :3, 3] *= unit
    return changed


def cropped(K: Tensor, pose: Tensor, evidence: Evidence) -> Hypothesis:
    """The shift of all centres with the least residuals, by steps to the eight sides."""
    best, step = K.new_zeros(2), 64.0
    ways = torch.cartesian_prod(*[K.new_tensor([0.0, -1, 1])] * 2)
    while step > 0.01:
        places = best + step * ways
        left = _left(evidence, [(shifted(K, place), pose) for place in places])
        nearest = places[left.index(min(left))]
        step = step / 2 if torch.equal(nearest, best) else step
        best = nearest
    return Hypothesis(Cause.CROPPED, (), None, shifted(K, best), pose)


def shifted(K: Tensor, shift: float | Tensor) -> Tensor:
    """K with its centre moved by ``shift`` px in x and y, or by two numbers."""
    moved = K.clone()
    moved[:, :2, 2] += shift
    return moved


def replaced(K: Tensor, pose: Tensor, chosen: slice, new_K: Tensor, new_pose: Tensor) -> Cameras:
    """All cameras with the chosen ones replaced."""
    K, pose = K.clone(), pose.clone()
    K[chosen], pose[chosen] = new_K, new_pose
    return K, pose


def _searched(
    cameras: Callable[[float], Cameras],
    evidence: Evidence,
    starts: list[float],
    common: tuple[float, ...],
    step: float,
) -> float:
    """The factor that leaves least, first among ``starts``, then around the best two of them."""

    def left(factors: Sequence[float]) -> list[float]:
        return _left(evidence, [cameras(factor) for factor in factors])

    ranked = sorted(zip(left(starts), starts, strict=True))
    centers, width = ranked[:2], math.log(step)
    while width > _FINEST:
        width *= 0.5
        beside = [factor * math.exp(side) for _, factor in centers for side in (-width, width)]
        found = [*zip(left(beside), beside, strict=True)]
        centers = [
            min(center, *found[2 * place : 2 * place + 2], key=lambda each: each[0])
            for place, center in enumerate(centers)
        ]
    least, best = min(centers, key=lambda each: each[0])
    # A round number, where it is as good.
    near = [factor for factor in common if abs(math.log(best / factor)) < 0.01]
    as_good = (f for f, of in zip(near, left(near), strict=True) if of <= 1.1 * least + 0.05)
    return next(as_good, best)


def _left(evidence: Evidence, cameras: list[Cameras]) -> list[float]:
    """Mean residual with each of several cameras, together: matches are few, and calls dear."""
    at_once = max(1, _MATCHES_AT_ONCE // max(1, evidence.first[..., 0].numel()))
    means: list[float] = []
    for start in range(0, len(cameras), at_once):
        K, pose = (
            torch.stack(some) for some in zip(*cameras[start : start + at_once], strict=True)
        )
        means += residuals(evidence, K, pose).mean(dim=-1).tolist()
    return means


def _epipolar(evidence: Evidence, K: Tensor, pose: Tensor) -> Tensor:
    """``(P, M)`` x1^T F x0."""
    first, second = evidence.pairs.unbind(dim=-1)
    inverse = inverse_up_to_scale(K)
    rotation, translation = pose[:, :3, :3], pose[:, :3, 3]
    turn = rotation[second] @ rotation[first].mT
    baseline = translation[second] - (turn @ translation[first, :, None])[..., 0]
    ray, other = (
        to_homogeneous(pixels) @ inverse[view].mT
        for pixels, view in ((evidence.first, first), (evidence.second, second))
    )
    lines = torch.linalg.cross(baseline[:, None].expand_as(ray), ray @ turn.mT)
    found: Tensor = (other * lines).sum(dim=-1)
    return found


def _joined(rotation: Tensor, translation: Tensor) -> Tensor:
    last = rotation.new_tensor([[0.0, 0, 0, 1]]).expand(len(rotation), 1, 4)
    return torch.cat([torch.cat([rotation, translation], dim=-1), last], dim=-2)
