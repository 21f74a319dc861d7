"""The short way of few points and the long way of many: one answer, and one gradient."""

from typing import NamedTuple

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from solvers import WAYS, Fields, by
from torch import Tensor
from torch.testing import assert_close
from triangulation_cases import noisy

from deltas_geom import PosedViews, Status, triangulate, triangulate_points
from deltas_geom.numerics import chunks, sums
from deltas_geom.testing import forward_motion, rigid
from deltas_geom.testing.fixed_scenes import seeded_scene
from deltas_geom.testing.strategies import vectors

TYPES = pytest.mark.parametrize("kind", [torch.float32, torch.float64], ids=str)
FRAMES = pytest.mark.parametrize("frame", ["rig", "world"])


class Asked(NamedTuple):
    """Arguments of a triangulation; the inputs have batch dims that broadcast."""

    proj: Tensor
    pixels: Tensor
    weights: Tensor | None
    mask: Tensor | None

    def to(self, kind: torch.dtype) -> "Asked":
        """In another type."""
        cast = (x if x is None or x.dtype == torch.bool else x.to(kind) for x in self)
        return Asked(*cast)

    def real(self) -> list[int]:
        """Which have a gradient."""
        return [k for k, x in enumerate(self) if x is not None and x.is_floating_point()]


@st.composite
def asked(draw: st.DrawFn, *, far: float) -> Asked:
    """Three noisy views of four points and what may be given beside them.

    Args:
        draw: given by hypothesis.
        far: how far the world's origin may be away, m.
    """
    scene, weights = draw(noisy())
    K, poses = scene.views
    away = rigid(draw(vectors(1, within=3.0)), draw(vectors(1, within=far)))
    several = draw(st.lists(st.booleans(), min_size=3, max_size=3))
    if several[0]:  # the same cameras in two worlds
        poses = torch.stack([poses, poses @ away]).unsqueeze(1)
        K = K.expand(2, 1, 3, 3, 3)
    else:
        poses = poses @ away
    pixels = scene.pixels
    if several[1]:
        pixels = torch.stack([pixels, pixels + draw(vectors(1, within=0.2, size=2)), pixels - 0.1])
    spoilt = draw(st.sampled_from([None, torch.nan, torch.inf]))
    if spoilt is not None:
        pixels = pixels.clone()
        pixels[..., 0, 1, 0] = spoilt
    chosen = draw(st.sampled_from(["nothing", "weights", "mask", "both"]))
    if several[2]:
        weights = torch.stack([weights, weights.flip(0), weights * 0.7]).unsqueeze(0)
    if draw(st.booleans()):
        signs = torch.tensor([1.0, -1, 1]).double()[:, None]
        weights = weights * signs
        weights[..., 0, 0] = 0
        weights[..., 1, 2] *= 1e-8  # no view
        weights[..., 2, 3] *= 0.1
    mask = torch.tensor(draw(st.lists(st.booleans(), min_size=12, max_size=12))).reshape(3, 4)
    mask[:, 2:] |= torch.tensor([[True], [False], [True]])
    return Asked(
        PosedViews(K, poses).proj,
        pixels,
        weights if chosen in ("weights", "both") else None,
        mask if chosen in ("mask", "both") else None,
    )


def answered(request: Asked, frame: str, way: str) -> Fields:
    with by(way):
        result = triangulate(*request, frame=frame, covariance=True)
        points = triangulate_points(*request, frame=frame)
    assert torch.equal(result.points, points)
    return {name: value for name, value in result._asdict().items() if value is not None}


@FRAMES
@TYPES
@given(data=st.data())
def test_both_ways_give_the_same_answers(
    kind: torch.dtype, frame: str, data: st.DataObject
) -> None:
    request = data.draw(asked(far=1000.0 if frame == "rig" else 1.0)).to(kind)
    short, long = (answered(request, frame, way) for way in WAYS)
    far = 1 + float(short["points"].abs().max())  # m from the world's origin
    near = 1e-9 if kind == torch.float64 else 1e-6
    # A pixel of float64 is known to 1e-13 px, but only to 1e-10 from a kilometre away.
    units = {"points": far, "depth": far, "residual": 10 * far, "errors": 10 * far}
    for name, value in short.items():
        if not value.is_floating_point():
            assert torch.equal(value, long[name]), name
            continue
        unit = units.get(name, 1.0)
        if name == "covariance":
            unit = far * float(value.abs().max())
        bound = near * unit
        assert_close(long[name], value, rtol=near, atol=bound, msg=lambda m, n=name: f"{n}: {m}")


def pulled(request: Asked, frame: str, way: str) -> list[Tensor]:
    """The gradient of a sum of points by what has one."""
    inputs = [
        x if x is None or k == 3 else x.detach().requires_grad_() for k, x in enumerate(request)
    ]
    with by(way):
        points = triangulate_points(*inputs, frame=frame)
        share = torch.arange(1.0, 1.0 + points.numel(), dtype=points.dtype).view_as(points)
        total = (points * share / points.numel()).sum()
        return list(torch.autograd.grad(total, [inputs[k] for k in request.real()]))


@FRAMES
@TYPES
@given(data=st.data())
def test_both_adjoints_are_the_derivative_of_all_that_is_computed(
    kind: torch.dtype, frame: str, data: st.DataObject
) -> None:
    request = data.draw(asked(far=1000.0 if frame == "rig" else 1.0)).to(kind)
    real = request.real()

    def solve(*some: Tensor) -> Tensor:
        full = list(request)
        for place, tensor in zip(real, some, strict=True):
            full[place] = tensor
        return triangulate_points(*full, frame=frame)

    points, pull = torch.func.vjp(solve, *(request[k] for k in real))
    share = torch.arange(1.0, 1.0 + points.numel(), dtype=points.dtype).view_as(points)
    whole = pull(share / points.numel())
    bound = 1e-8 if kind == torch.float64 else 1e-5
    for way in WAYS:
        for ours, theirs in zip(pulled(request, frame, way), whole, strict=True):
            assert ours.isfinite().all()
            size = 1 + float(theirs.abs().max())
            assert_close(ours, theirs, rtol=0, atol=bound * size, msg=lambda m, w=way: f"{w}: {m}")


LAYOUTS = {
    "plain": lambda x: x,
    "transposed": lambda x: x.mT.contiguous().mT,
    "every other": lambda x: torch.stack([x, x], dim=-1).flatten(-2)[..., ::2],
    "reversed batch": lambda x: x.flip(0).contiguous().flip(0),
    "expanded": lambda x: x[:1].expand_as(x),
    "one column": lambda x: x[..., :1].expand_as(x),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 16, 17])
def test_products_in_blocks_are_products(
    count: int, layout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sums, "_SERIAL_PRODUCT", 8 * 15)  # eight columns of 5 rows and 3 views
    random = torch.Generator().manual_seed(count)

    def drawn(*shape: int) -> Tensor:
        tensor = torch.randn(*shape, generator=random, dtype=torch.float64)
        return LAYOUTS[layout](tensor) if tensor.numel() else tensor

    a, b, c = drawn(2, 5, 3), drawn(2, 3, count), drawn(2, 5, count)
    assert_close(sums.product(a, b), a @ b)
    assert_close(sums.product(a[0], b), a[0] @ b)
    assert_close(sums.product(a, b[1]), a @ b[1])
    assert_close(sums.product(a.unsqueeze(1), b), a.unsqueeze(1) @ b)
    assert_close(sums.over_points(c, b), c @ b.mT)
    assert_close(sums.over_points(c[0], b), c[0] @ b.mT)
    assert_close(torch.stack(sums.over_views(a, b), dim=-2), a @ b)
    assert_close(torch.stack(sums.over_views(a, *b.split([1, 2], dim=-2)), dim=-2), a @ b)
    with monkeypatch.context() as compiled:
        compiled.setattr(torch.compiler, "is_compiling", lambda: True)
        in_parts = sums.over_views(a, *b.split([1, 2], dim=-2))
    assert_close(torch.stack(in_parts, dim=-2), a @ b)
    assert_close(sums.product(a[:0], b[:0]), a[:0] @ b[:0])
    assert_close(sums.product(a[..., :0], b[..., :0, :]), a[..., :0] @ b[..., :0, :])
    leaves = [x.clone().requires_grad_() for x in (a, b, c)]
    for ours, plain in (
        (sums.product(*leaves[:2]), leaves[0] @ leaves[1]),
        (sums.over_points(leaves[2], leaves[1]), leaves[2] @ leaves[1].mT),
    ):
        gradients = torch.autograd.grad(ours.square().sum(), leaves, materialize_grads=True)
        wanted = torch.autograd.grad(plain.square().sum(), leaves, materialize_grads=True)
        assert_close(gradients, wanted)


@pytest.mark.parametrize("extra", [-1, 0, 1])
def test_products_around_the_real_block_are_products(extra: int) -> None:
    random = torch.Generator().manual_seed(0)
    count = sums._SERIAL_PRODUCT // 20 + extra
    for kind in (torch.float32, torch.float64):
        a = torch.randn(10, 2, generator=random, dtype=torch.float64).to(kind)
        b = torch.randn(2, count, generator=random, dtype=torch.float64).to(kind)
        assert_close(sums.product(a, b), a @ b)
        c = a[:, :1] * b[:1]
        assert_close(
            sums.over_points(c, b), c @ b.mT, rtol=16 * torch.finfo(kind).eps, atol=1e-6 * count
        )
    assert sums.product(a.float(), b.float()).dtype == torch.float32


def test_a_pixel_that_is_not_finite_fails_alone_however_points_are_cut(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    scene = forward_motion()
    proj = scene.views.proj.repeat(2, 1, 1)
    pixels = scene.pixels.repeat(2, 7000, 1)  # more than a part, and more than a chunk
    failing = [5, 9000, 20_999]
    pixels[1, failing] = torch.nan
    found = triangulate(proj, pixels)
    assert found.valid.logical_not().nonzero().flatten().tolist() == failing
    assert (found.status[failing] == Status.NOT_FINITE_INPUT).all()
    sound = found.valid.nonzero().flatten()
    assert_close(found.points[sound], scene.points.repeat(7000, 1)[sound], rtol=0, atol=1e-9)


def test_an_exported_program_holds_a_product_as_nobody_fuses_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    a, b = torch.rand(5, 3), torch.rand(3, 7)
    monkeypatch.delattr(sums, "_FusedSums")
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    assert_close(torch.stack(sums.over_views(a, *b.split([1, 2]))), a @ b)


def test_most_cameras_may_stand_far_from_a_point_that_they_do_not_see() -> None:
    scene = seeded_scene(3, num_views=2, num_points=5)
    proj, pixels = (
        x.repeat_interleave(4, dim=0)[3:].float() for x in (scene.views.proj, scene.pixels)
    )
    proj[1:-1, 0, 3] += 1e9  # some 1000 km
    seen = torch.zeros(5, 5, dtype=torch.bool)
    seen[[0, -1]] = True
    with by("short"):
        found = triangulate(proj, pixels, mask=seen)
    assert found.valid.all()
    assert_close(found.points.double(), scene.points, rtol=0, atol=1e-3)  # m


@pytest.mark.parametrize("way", WAYS)
def test_a_point_farther_than_float32_goes_is_at_infinity(way: str) -> None:
    proj, pixels = torch.eye(3, 4).repeat(2, 1, 1), torch.zeros(2, 2, 2)
    proj[1, 0, 3] = -1e37  # m to the right
    pixels[1, :, 0] = torch.tensor([-0.02, -0.1])  # at 5e38 and at 1e38 m
    with by(way):
        found = triangulate(proj, pixels)
    assert found.status.tolist() == [Status.AT_INFINITY.value, Status.OK.value]
    assert found.points.isfinite().all()


def test_chunks_of_one_call_have_gradients_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "SERIAL", 4 * 3)  # numbers: four points of three views
    monkeypatch.setattr(chunks, "_SMALLEST_CHUNK", 4)
    scene = seeded_scene(3, num_views=3, num_points=8, noise=0.5)
    pixels = scene.pixels.requires_grad_(True)
    together, apart = (
        torch.cat([triangulate_points(scene.views.proj, part, frame="world") for part in parts])
        for parts in ([pixels], pixels.split(1, dim=1))
    )
    found, wanted = (torch.autograd.grad(p.square().sum(), pixels)[0] for p in (together, apart))
    assert_close(found, wanted)


def test_no_used_camera_has_a_valid_point_behind_it_by_rounding() -> None:
    away = torch.eye(4).double()
    away[:3, 3] = torch.tensor([1e5, -2.3e5, 1.7e5])  # m, to the world's origin
    scene = seeded_scene(20, num_views=3, num_points=1)
    K, poses = scene.views[0], scene.views[1].clone()
    poses[2, :3, 3] = -(poses[2, :3, :3] @ scene.points[0])  # at the point itself
    random = torch.Generator().manual_seed(20)
    pixels = scene.pixels.expand(3, 200, 2) + 1e-9 * torch.randn(3, 200, 2, generator=random)
    with by("long"):
        found = triangulate(PosedViews(K, poses @ away).proj, pixels)
    assert found.valid.sum() > 30
    assert (found.depth >= 0).all()


@pytest.mark.parametrize("tiny", [1e-2, 1e-4, 1e-5])
@pytest.mark.parametrize("views", [2, 3])
def test_where_one_view_outweighs_all_others_what_is_derived_is_the_adjoint(
    views: int, tiny: float
) -> None:
    scene = seeded_scene(3, num_views=views, num_points=6, noise=1.0)
    weights = torch.ones(views, 6).double()
    weights[1:] = tiny
    inputs = [x.clone().requires_grad_() for x in (scene.views.proj, scene.pixels, weights)]
    points = triangulate_points(*inputs).sum()
    adjoint = torch.autograd.grad(points, inputs, retain_graph=True)
    derived = torch.autograd.grad(points, inputs, create_graph=True)
    # What the squares of rows lose of a small weight's digits.
    lost = 1e-13 / tiny**2
    for ours, theirs in zip(derived, adjoint, strict=True):
        assert_close(ours, theirs, rtol=0, atol=lost * (1 + float(theirs.abs().max())))
    assert_close(derived[2][1:], adjoint[2][1:], rtol=0.05, atol=1e-8)
