"""The stage that draws agreed maps anew: what it keeps, what it learns, where its weights go."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from run_command import Run, assert_one_line
from safetensors import safe_open

from deltas_geom import PosedViews
from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.scaled import scaled
from deltas_nets.captures.straight import straight
from deltas_nets.errors import UserError
from deltas_nets.network.build import build_stages
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.known_depth import KnownDepth, as_points
from deltas_nets.network.lite.redraw import WINDOW, Redraw, kept_at_large
from deltas_nets.outputs.first_maps import FirstMaps
from deltas_nets.predict.later_passes import LaterPasses
from deltas_nets.predict.ours import DeltasPredictor
from deltas_nets.predict.views_alone import ViewsAlone
from deltas_nets.train.heard_rooms import HeardRooms, hear_each_other
from deltas_nets.train.redraw import (
    RedrawConfig,
    heard_rooms,
    learns,
    lesson,
    train_redraw,
    with_redraw,
)
from deltas_nets.weights_file import load_model, read_metadata, save_weights, start_from_weights

HERE = Path("weights.safetensors")
SEEDS = st.integers(0, 2**31)


def maps(seed: int, size: tuple[int, int] = (24, 40)) -> torch.Tensor:
    """Depth ``(1, 1, H, W)`` with edges."""
    random = torch.Generator().manual_seed(seed)
    depth = 1 + 3 * torch.rand(1, 1, *size, generator=random)
    depth[..., :, size[1] // 2 :] += 2
    return depth


@given(SEEDS, st.floats(0.01, 100), st.floats(0, 0.9))
def test_a_map_that_is_off_by_a_factor_loses_it(seed: int, factor: float, share: float) -> None:
    agreed = maps(seed)
    holes = torch.rand(agreed.shape, generator=torch.Generator().manual_seed(seed)) < share
    kept = kept_at_large((factor * agreed).log(), agreed.masked_fill(holes, 0.0))
    near = torch.nn.functional.max_pool2d((~holes).float(), WINDOW, 1, WINDOW // 2) > 0
    torch.testing.assert_close(kept[near], agreed.log()[near], rtol=1e-4, atol=1e-4)


@given(SEEDS, SEEDS)
def test_what_was_agreed_on_stays_in_the_mean(seed: int, other: int) -> None:
    agreed, drawn = maps(seed), maps(other)
    kept = kept_at_large(drawn.log(), agreed)
    # Farther from the border than twice the window, the mean over three windows is the agreed one.
    wide = torch.nn.functional.avg_pool2d(kept - agreed.log(), (24, 40))
    before = torch.nn.functional.avg_pool2d(drawn.log() - agreed.log(), (24, 40))
    assert wide.abs().max() < 0.05 + 0.1 * before.abs().max()


@given(SEEDS, st.floats(0, 1))
def test_holes_of_the_agreed_map_are_filled_by_what_is_drawn(seed: int, share: float) -> None:
    agreed, drawn = maps(seed), maps(seed + 1).log()
    holes = torch.rand(agreed.shape, generator=torch.Generator().manual_seed(seed)) < share
    kept = kept_at_large(drawn, agreed.masked_fill(holes, 0.0))
    assert kept.isfinite().all()
    unknown = torch.nn.functional.avg_pool2d((~holes).float(), WINDOW, 1, WINDOW // 2) == 0
    torch.testing.assert_close(kept[unknown], drawn[unknown])


@pytest.fixture(scope="module")
def shipped() -> Deltas:
    return load_model()


@pytest.fixture
def plain(shipped: Deltas) -> Deltas:
    """The shipped network without the stage."""
    model = Deltas(replace(shipped.config, redraws=False))
    own = model.state_dict()
    model.load_state_dict({name: shipped.state_dict()[name] for name in own})
    return model.eval()


def views_of(count: int) -> tuple[torch.Tensor, PosedViews]:
    torch.manual_seed(0)
    K = torch.tensor([[60.0, 0, 47.5], [0, 60, 31.5], [0, 0, 1]]).expand(count, 3, 3)
    pose = torch.eye(4).repeat(count, 1, 1)
    pose[:, 0, 3] = -0.1 * torch.arange(count)
    return torch.rand(count, 3, 64, 96), PosedViews(K, pose)


@torch.inference_mode()
def test_the_new_stage_starts_as_the_densifier_and_changes_no_map_of_one_pass(
    plain: Deltas,
) -> None:
    wider = with_redraw(plain, HERE)
    assert isinstance(wider.redraw, Redraw)
    for name, weight in wider.redraw.densifier.state_dict().items():
        torch.testing.assert_close(weight, plain.densifier.state_dict()[name], rtol=0, atol=0)
    images, views = views_of(2)
    expected, found = plain(images, views), wider(images, views)
    torch.testing.assert_close(found.depth, expected.depth, rtol=0, atol=0)
    torch.testing.assert_close(found.std, expected.std, rtol=0, atol=0)


@torch.inference_mode()
def test_without_the_stage_agreed_maps_stay(plain: Deltas) -> None:
    images, _ = views_of(1)
    agreed = KnownDepth(maps(0, (64, 96)), torch.full((1, 1, 64, 96), 0.05))
    assert plain.redrawn(plain.encode(images[None]), agreed) is agreed
    drawn = with_redraw(plain, HERE).redrawn(plain.encode(images[None]), agreed)
    assert (drawn.depth != agreed.depth).any() and drawn.depth.isfinite().all()
    assert (drawn.deviation != agreed.deviation).all() and (drawn.deviation > 0).all()


@torch.inference_mode()
def test_the_deviation_is_between_what_frames_state_and_what_the_stage_learned(
    plain: Deltas,
) -> None:
    model = with_redraw(plain, HERE)
    encoded = model.encode(views_of(1)[0][None])
    depth = maps(0, (64, 96))
    depth[..., :20] = 0

    def stated(deviation: float) -> torch.Tensor:
        return model.redrawn(
            encoded, KnownDepth(depth, torch.full_like(depth, deviation))
        ).deviation

    known = depth > 0
    # A deviation near 0 leaves the weights of the points, and so what is drawn, as they are.
    ratio = stated(1e-6) / stated(4e-6)
    torch.testing.assert_close(ratio[known], torch.full_like(ratio[known], 0.5))
    torch.testing.assert_close(ratio[~known], torch.ones_like(ratio[~known]))


@torch.inference_mode()
def test_the_stage_is_a_densifier_of_the_map_that_keeps_it_at_large(plain: Deltas) -> None:
    stage = with_redraw(plain, HERE).redraw
    assert isinstance(stage, Redraw)
    images, _ = views_of(1)
    features = plain.encode(images[None]).features
    agreed = KnownDepth(maps(0, (64, 96)), torch.full((1, 1, 64, 96), 0.05))
    drawn = stage.densifier(features, as_points(agreed)).log_depth[0]
    expected = kept_at_large(drawn, agreed.depth)
    torch.testing.assert_close(stage(features, agreed).log_depth[0], expected)
    assert (expected - drawn).abs().max() > 1e-3


def small(out: Path, **changes: Any) -> RedrawConfig:
    few = RedrawConfig(out, num_rooms=2, num_views=3, num_sources=1, batch_size=2, workers=0)
    return replace(few, sizes=((64, 96),), steps=1, **changes)


@pytest.fixture(scope="module")
def heard(shipped: Deltas, tmp_path_factory: pytest.TempPathFactory) -> HeardRooms:
    rooms = heard_rooms(shipped, small(HERE), tmp_path_factory.mktemp("rooms"))
    assert [rooms[0], rooms[1]] == [0, 1]
    return rooms


def test_a_view_of_a_room_is_what_was_made_of_it(heard: HeardRooms) -> None:
    room, view = heard.rooms[1], heard.view(1, 2)
    torch.testing.assert_close(view.image, room.images[2].float() / 255)
    torch.testing.assert_close(view.depth[0], room.depth[2], rtol=1e-3, atol=0)
    assert view.agreed.depth.shape == view.depth.shape == (1, 64, 96)
    assert (view.agreed.depth > 0).all() and (view.agreed.deviation > 0).all()


def test_rooms_are_made_once_and_again_where_they_are_damaged(
    heard: HeardRooms, tmp_path: Path
) -> None:
    other = HeardRooms(heard.rooms, heard.model, tmp_path, num_sources=1, seed=heard.seed)
    other[0]
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    assert whole == (heard.folder / file.name).read_bytes()  # whatever was made before
    changed = file.stat().st_mtime_ns
    other[0]
    assert file.stat().st_mtime_ns == changed
    file.write_bytes(whole[:5000])
    other[0]
    assert file.read_bytes() == whole


@torch.inference_mode()
def test_maps_that_hear_each_other_in_memory_do_as_those_of_a_capture(
    heard: HeardRooms, capture: Capture, tmp_path: Path
) -> None:
    """As `deltas depth` has it: the maps of the first pass hear those of the pass before."""
    ids = list(capture.frames)[:4]
    size, first = (64, 96), FirstMaps(tmp_path / "first")
    alone = KnownDepth(
        torch.stack([torch.full((1, *size), 2 + 0.04 * n) for n in range(4)]),
        torch.full((4, 1, *size), 0.05),
    )
    for n, id in enumerate(ids):
        first.write(id, KnownDepth(*(part[n] for part in alone)), {})
    passes = LaterPasses(capture, first, ids, ViewsAlone())  # type: ignore[arg-type]
    second = first.of_pass(2)
    for id in ids:
        second.write(id, passes.hear(id, first), {})
    views = passes_views(capture, ids, size)
    for passed, told in ((2, first), (3, second)):
        found = hear_each_other(alone, views, passes=passed)
        for n, id in enumerate(ids):
            expected = passes.hear(id, told)
            torch.testing.assert_close(found.depth[n], expected.depth, rtol=1e-4, atol=1e-4)
    once = hear_each_other(alone, views, passes=2)
    assert (once.depth - alone.depth).abs().max() > 0.01, "they agree"
    assert (found.depth - once.depth).abs().max() > 1e-3, "and hear what has heard"


def passes_views(capture: Capture, ids: list[str], size: tuple[int, int]) -> PosedViews:
    frames = [straight(capture.frame(id)) for id in ids]
    Ks = [
        resize_intrinsics(torch.tensor(f.K), old_size=f.image_size, new_size=size) for f in frames
    ]
    return PosedViews(
        torch.stack(Ks), torch.stack([torch.tensor(f.cam_from_world) for f in frames])
    )


def test_a_lesson_is_a_function_of_its_step(heard: HeardRooms) -> None:
    config = small(HERE)
    first, again, other = (lesson(heard, config, step) for step in (0, 0, 1))
    assert first.images.equal(again.images) and first.agreed.depth.equal(again.agreed.depth)
    assert not first.images.equal(other.images)
    # Some are mirrored, and then all of a view is.
    views = [heard.view(room, view) for room in range(2) for view in range(3)]
    for image, depth in zip(first.images, first.depth, strict=True):
        assert any(
            (image.equal(v.image) and depth.equal(v.depth))
            or (image.equal(v.image.flip(-1)) and depth.equal(v.depth.flip(-1)))
            for v in views
        )


def test_a_lesson_is_learned_and_nothing_else_changes(plain: Deltas, heard: HeardRooms) -> None:
    model = with_redraw(plain, HERE)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    assert model.redraw is not None
    optimizer = torch.optim.AdamW(model.redraw.parameters(), lr=1e-3)
    taught = lesson(heard, small(HERE), 0)
    said = [learns(model, taught, optimizer) for _ in range(12)]
    assert said[-1]["loss"] < 0.9 * said[0]["loss"]
    assert said[0]["abs_rel_agreed"] == said[-1]["abs_rel_agreed"] > 0
    changed = {n for n, tensor in model.state_dict().items() if not tensor.equal(before[n])}
    assert changed and all(name.startswith("redraw.") for name in changed)


def test_the_stage_is_written_read_and_left_behind(plain: Deltas, tmp_path: Path) -> None:
    network = tmp_path / "network.safetensors"
    save_weights(network, plain, {"origin": "somewhere", "step": "7", "seed": "3"})
    log, out = tmp_path / "new" / "log.jsonl", tmp_path / "redraws.safetensors"
    train_redraw(small(out, init=str(network), seed=5, log=log))
    record, model = read_metadata(out), load_model(out)
    assert model.config.redraws and model.redraw is not None
    assert (record["redraw_step"], record["redraw_seed"]) == ("1", "5")
    assert (record["origin"], record["step"], record["seed"]) == ("somewhere", "7", "3")
    assert len(log.read_text().splitlines()) == 1
    assert str(tmp_path) not in " ".join(record.values()) and "log" not in record["redraw_config"]
    # Another training's log is neither added to nor lost unasked.
    another = tmp_path / "another.safetensors"
    with pytest.raises(UserError, match=r"the file exists.*log\.jsonl: add --overwrite"):
        train_redraw(small(another, init=str(network), log=log))
    assert not another.exists()
    train_redraw(small(another, init=str(network), log=log), overwrite=True)
    assert len(log.read_text().splitlines()) == 1
    # Training of all goes on without it: it follows features that are about to change.
    fresh = build_stages(plain.config)
    assert fresh.redraw is None
    grown = Deltas(plain.config)
    assert start_from_weights(grown, out) == []
    assert not any(name.startswith("redraw.") for name in grown.state_dict())


def test_trained_stages_go_on(plain: Deltas, tmp_path: Path) -> None:
    network, once = tmp_path / "network.safetensors", tmp_path / "once.safetensors"
    save_weights(network, plain, {})
    train_redraw(small(once, init=str(network)))
    again = with_redraw(load_model(once), once)
    with safe_open(once, framework="pt") as opened:
        name = next(name for name in opened.keys() if name.startswith("redraw."))  # noqa: SIM118
        torch.testing.assert_close(again.state_dict()[name], opened.get_tensor(name))
    twice = tmp_path / "twice.safetensors"
    train_redraw(small(twice, init=str(once), seed=1))
    assert read_metadata(twice)["redraw_config"].count('"seed"') == 2


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--out", "weights.pt"), (".safetensors",)),
        (("--out", "w.safetensors", "--init", "nothing"), ("no such weights",)),
        (("--out", "w.safetensors", "--batch-size", 0), ("batch_size",)),
        (("--out", "w.safetensors", "--num-views", 2), ("num_views",)),
        (("--out", "w.safetensors", "--num-views", 13), ("at most 12",)),
        (("--out", "w.safetensors", "--close-ups", 2), ("close_ups",)),
        (("--out", "w.safetensors", "--num-rooms", 0), ("num_rooms",)),
        (("--out", "w.safetensors", "--sizes", 10, 10), ("32 or more",)),
        (("--out", "w.safetensors", "--first-room", 5), ("1000 or more",)),
        (("--out", "w.safetensors", "--log", "/dev/null/x.jsonl"), ("/dev/null",)),
        (("--out", "w.safetensors", "--cache", "/dev/null/rooms"), ("/dev/null",)),
        (("--out", "w.safetensors", "--init", "no-points"), ("no such weights",)),
    ],
)
def test_wrong_use_is_told(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: Any, words: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_one_line(run("redraw", *flags), *words)
    (tmp_path / "folder").mkdir()
    assert_one_line(run("redraw", "--out", "w.safetensors", "--log", "folder"), "this is a folder")
    (tmp_path / "folder").rmdir()
    assert not list(tmp_path.iterdir())


def test_a_capture_in_another_unit_is_drawn_alike(
    capture: Capture, tmp_path: Path, plain: Deltas
) -> None:
    """The stage knows metres, so maps go to it in those that the network takes the unit for."""
    predictor = DeltasPredictor(with_redraw(plain, HERE))
    id, found = next(iter(capture.frames)), []
    for scale in (1.0, 250.0):
        in_unit = scaled(capture, scale, metric=False)
        first = FirstMaps(tmp_path / str(scale))
        map = KnownDepth(scale * maps(3, (64, 96))[0], torch.full((1, 64, 96), 0.05))
        first.write(id, map, {})
        passes = LaterPasses(in_unit, first, [id], predictor)
        found.append(passes.drawn(id, map).depth / scale)
    torch.testing.assert_close(found[1], found[0], rtol=1e-4, atol=0)
    assert not found[0].equal(maps(3, (64, 96))[0])


@given(SEEDS)
def test_around_a_pixel_is_a_square_less_what_is_outside(seed: int) -> None:
    image = maps(seed, (30, 50))
    inside = torch.nn.functional.avg_pool2d(
        image, WINDOW, stride=1, padding=WINDOW // 2, count_include_pad=False
    )
    # Of a map of zeros that was agreed on everywhere, what is kept is less its mean around.
    kept = kept_at_large(image, torch.ones_like(image))
    torch.testing.assert_close(image - kept, inside, rtol=1e-4, atol=1e-5)
