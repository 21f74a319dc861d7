"""Maps that are compared with the images around them."""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets import load_model
from deltas_nets.agree.compared import LEAST, MOST, SHARE, SHARPNESS, STEPS, Described, compared
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.scaled import scaled
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.outputs.first_maps import FirstMaps
from deltas_nets.predict.described import AtSize, DescribedFrames
from deltas_nets.predict.later_passes import LaterPasses
from deltas_nets.predict.ours import DeltasPredictor
from deltas_nets.predict.views_alone import ViewsAlone

SEEDS = st.integers(0, 2**16)
SIZE, DIM = (24, 32), 8
FOCAL = 40.0


def camera(x: float, y: float, z: float = 0.0) -> PosedViews:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -torch.tensor([x, y, z], dtype=torch.float64)
    K = torch.tensor([[FOCAL, 0, 15.5], [0, FOCAL, 11.5], [0, 0, 1]], dtype=torch.float64)
    return PosedViews(K[None], pose[None])


def wall(seed: int, depth: float, views: Sequence[PosedViews]) -> list[Described]:
    """A textured wall in front of cameras that stand upright."""
    random = torch.Generator().manual_seed(seed)
    waves = torch.randn(DIM, 2, generator=random, dtype=torch.float64) * 30
    phase = torch.randn(DIM, generator=random, dtype=torch.float64) * 3
    seen = []
    for view in views:
        rows, columns = torch.meshgrid(*(torch.arange(n).double() for n in SIZE), indexing="ij")
        pixels = torch.stack([columns, rows], dim=-1).reshape(-1, 2)
        at = (pixels - view.K[0, :2, 2]) / FOCAL * depth - view.cam_from_world[0, :2, 3]
        found = F.normalize((at @ waves.mT + phase).sin().float(), dim=-1)
        seen.append(Described(found, SIZE, view))
    return seen


VIEWS = [camera(0, 0), camera(0.15, 0), camera(-0.12, 0.05), camera(0.02, -0.14)]


def maps(depth: float, deviation: float) -> KnownDepth:
    return KnownDepth(*(torch.full((1, *SIZE), value) for value in (depth, deviation)))


@given(SEEDS, st.sampled_from([-0.04, 0.04]))
def test_a_map_moves_to_where_the_images_show_the_same(seed: int, off: float) -> None:
    anchor, *others = wall(seed, 1.0, VIEWS)
    before = maps(math.exp(off), 0.1)
    after = compared(before, anchor, others)
    error, less = (m.depth.log().abs()[0, 4:-4, 4:-4].mean() for m in (before, after))
    assert less < 0.95 * error
    assert (after.deviation <= before.deviation * 1.01).float().mean() > 0.9


@given(SEEDS, st.floats(0.01, 100.0))
def test_units_do_not_matter(seed: int, unit: float) -> None:
    views = [camera(*(unit * c for c in place)) for place in ((0, 0), (0.15, 0), (0.1, 0.1))]
    anchor, *others = wall(seed, 1.0, [VIEWS[0], camera(0.15, 0), camera(0.1, 0.1)])
    one = compared(maps(1.03, 0.05), anchor, others)
    mine, *rest = (seen._replace(view=v) for seen, v in zip((anchor, *others), views, strict=True))
    other = compared(maps(1.03 * unit, 0.05), mine, rest)
    torch.testing.assert_close(other.depth / unit, one.depth, rtol=1e-4, atol=0)
    torch.testing.assert_close(other.deviation, one.deviation, rtol=1e-3, atol=0)


@given(SEEDS)
def test_images_that_show_nothing_leave_the_map(seed: int) -> None:
    random = torch.Generator().manual_seed(seed)
    found = KnownDepth(
        1 + torch.rand(1, *SIZE, generator=random), 0.01 + torch.rand(1, *SIZE, generator=random)
    )
    plain = torch.ones(SIZE[0] * SIZE[1], DIM) / DIM**0.5
    anchor, *others = (Described(plain, SIZE, view) for view in VIEWS)
    elsewhere = camera(0, 0, z=50.0)  # everything is behind it
    for around in (others, [Described(plain, SIZE, elsewhere)]):
        same = compared(found, anchor, around)
        torch.testing.assert_close(same.depth, found.depth, rtol=1e-5, atol=0)
        torch.testing.assert_close(same.deviation, found.deviation, rtol=1e-4, atol=0)
    assert compared(found, anchor, []) is found


@given(SEEDS)
def test_an_image_that_does_not_see_a_place_has_no_say(seed: int) -> None:
    anchor, *others = wall(seed, 1.0, VIEWS)
    random = torch.Generator().manual_seed(seed)
    noise = F.normalize(torch.randn(SIZE[0] * SIZE[1], DIM, generator=random), dim=-1)
    blind = [Described(noise, SIZE, camera(*place)) for place in ((0, 0, 50), (500, 0, 0))]
    found = maps(1.03, 0.08)
    expected = compared(found, anchor, others)
    for part, same in zip(compared(found, anchor, [*blind, *others]), expected, strict=True):
        torch.testing.assert_close(part, same, rtol=1e-5, atol=0)


@given(SEEDS, st.floats(1e-3, 1e3), st.floats(1e-6, 1e4))
def test_no_map_leaves_what_was_searched(seed: int, far: float, deviation: float) -> None:
    random = torch.Generator().manual_seed(seed)
    anchor, *others = (
        Described(
            F.normalize(torch.randn(SIZE[0] * SIZE[1], DIM, generator=random), dim=-1), SIZE, view
        )
        for view in (VIEWS[0], camera(far, 0), camera(0, -far, far))
    )
    found = maps(1.0, deviation)
    found.depth[0, :3] = 0
    after = compared(found, anchor, others)
    assert after.depth.isfinite().all() and after.deviation.isfinite().all()
    assert (after.depth[0, :3] == 0).all() and (after.deviation > 0).all()
    reach = max(STEPS) * min(max(SHARE * deviation, LEAST), MOST)
    assert after.depth[0, 4:].log().abs().max() <= reach + 1e-5


@given(SEEDS)
def test_as_with_grid_sample_in_double_precision(seed: int) -> None:
    """Where the other images see all depths: a slow reading of them, in another way."""
    anchor, *others = wall(seed, 1.0, VIEWS)
    found = maps(1.02, 0.05)
    found.depth.mul_(1 + 0.05 * torch.rand(SIZE, generator=torch.Generator().manual_seed(seed)))
    expected, narrower, inside = slowly(found, anchor, others)
    after = compared(found, anchor, others)
    assert inside.float().mean() > 0.3
    moved = (after.depth / found.depth).log()[0].double()
    torch.testing.assert_close(moved[inside], expected[inside], rtol=0, atol=2e-5)
    left = (after.deviation / found.deviation)[0].double()
    torch.testing.assert_close(left[inside], narrower[inside].sqrt(), rtol=0, atol=1e-4)


def slowly(
    found: KnownDepth, anchor: Described, others: Sequence[Described]
) -> tuple[Tensor, Tensor, Tensor]:
    """How the log of depth moves, what is left of the spread, and where all depths are seen."""
    height, width = SIZE
    rows, columns = torch.meshgrid(*(torch.arange(n).double() for n in SIZE), indexing="ij")
    spread = (SHARE * found.deviation[0].double()).clamp(LEAST, MOST)
    image = anchor.rows.double().reshape(*SIZE, DIM)
    likelihood, inside = [], torch.ones(SIZE, dtype=torch.bool)
    for step in STEPS:
        z = found.depth[0].double() * (step * spread).exp()
        in_world = torch.stack(
            [(columns - 15.5) / FOCAL * z, (rows - 11.5) / FOCAL * z, z, torch.ones_like(z)]
        )
        alike = []
        for other in others:
            x, y, w = torch.einsum("ij,jhw->ihw", other.view.proj[0, :3], in_world)
            x, y = x / w, y / w
            inside &= (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
            grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=-1)
            theirs = other.rows.double().mT.reshape(1, DIM, *SIZE)
            read = F.grid_sample(theirs, grid[None], align_corners=False)[0]
            alike.append((read * image.permute(2, 0, 1)).sum(dim=0))
        likelihood.append(SHARPNESS * torch.stack(alike).mean(dim=0) - step**2 / 2)
    chosen = torch.stack(likelihood).softmax(dim=0)
    steps = torch.tensor(STEPS, dtype=torch.float64)
    prior = (-steps.square() / 2).softmax(dim=0)
    mean, square = (torch.einsum("shw,s->hw", chosen, steps**power) for power in (1, 2))
    narrower = ((square - mean.square()) / (prior @ steps.square())).sqrt()
    return mean * spread, narrower, inside


def test_frames_are_described_once(capture: Capture) -> None:
    predictor = DeltasPredictor(load_model())
    encoded: list[str] = []
    encode = predictor.encode

    class Counting(type(encode)):  # type: ignore[misc]
        def __call__(self, frames: object, *, work_size: tuple[int, int]) -> object:
            encoded.append("once")
            return encode(frames, work_size=work_size)  # type: ignore[arg-type]

    describe = DescribedFrames(Counting(encode.model), capacity=2 * 32 * 48 * 48)
    frames = list(capture.frames.values())[:3]
    first = describe(AtSize(frames[0], (64, 96)))
    again = describe(AtSize(frames[0], (64, 96)))
    assert first.rows.equal(again.rows) and len(encoded) == 1
    assert first.size == (32, 48) and first.rows.shape == (32 * 48, 48)
    torch.testing.assert_close(first.rows.norm(dim=-1), torch.ones(32 * 48), rtol=0, atol=0.02)
    maps = encode([frames[0]], work_size=(64, 96)).encoded.descriptors.maps[0, 0]
    torch.testing.assert_close(first.rows, maps.flatten(1).mT, rtol=0, atol=0.5 / 127 + 1e-6)
    for frame in frames[1:]:
        describe(AtSize(frame, (64, 96)))
    describe(AtSize(frames[0], (64, 96)))  # forgotten meanwhile
    assert len(encoded) == 4


@pytest.mark.parametrize("unit", [1.0, 250.0])
def test_what_is_drawn_is_compared_with_frames_around(
    capture: Capture, tmp_path: Path, unit: float
) -> None:
    in_unit = scaled(capture, unit, metric=unit == 1)
    asked: list[tuple[str, list[str], tuple[int, int]]] = []

    class Predictor(ViewsAlone):
        def compared(
            self, anchor: AtSize, drawn: KnownDepth, around: Sequence[AtSize]
        ) -> KnownDepth:
            asked.append((anchor.frame.id, [seen.frame.id for seen in around], anchor.size))
            assert float(drawn.depth.mean()) == pytest.approx(2 * unit)
            return drawn._replace(depth=2 * drawn.depth)

    ids, first = list(capture.frames)[:4], FirstMaps(tmp_path / "first")
    map = KnownDepth(torch.full((1, 64, 96), 2.0 * unit), torch.full((1, 64, 96), 0.05))
    for id in ids:
        first.write(id, map, {})
    passes = LaterPasses(in_unit, first, ids, Predictor())  # type: ignore[arg-type]
    drawn = passes.drawn(ids[0], map)
    torch.testing.assert_close(drawn.depth, 2 * map.depth)
    ((anchor, around, size),) = asked
    assert anchor == ids[0] and size == (64, 96)
    assert around and ids[0] not in around and set(around) < set(ids)
