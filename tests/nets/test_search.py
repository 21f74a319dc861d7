"""What is searched follows from the capture, in any unit; an oracle stands for the network."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame, Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.keyframes import keyframes
from deltas_nets.captures.known_depths import farthest_depth, points_in_view
from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.captures.scaled import scaled
from deltas_nets.captures.straight import lens_of
from deltas_nets.captures.view_choice import choose_view_sets
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.working_depth import (
    SPACINGS,
    guessed_depth,
    knows_its_scale,
    working_depths,
)
from deltas_nets.errors import UserError
from deltas_nets.outputs.verdict import verdict
from deltas_nets.predict import search
from deltas_nets.predict.depth_map import DepthMap, KeypointDepths, PredictConfig, Wanted
from deltas_nets.predict.first_look import depth_seen, scale_by_measurements, scale_by_sensor
from deltas_nets.predict.look import look
from deltas_nets.predict.reach import ROOM, Reach, end_of_pile, reach_of
from deltas_nets.predict.search import Asked, Followed

VIEWS = ViewSet("1", ("0", "2"))
UNITS = st.floats(-3, 3).map(lambda power: float(10**power))


class Oracle:
    """Finds a wall where it is, or the end of the range that is nearest to it."""

    def __init__(self, wall: float) -> None:
        self.wall = wall
        self.asked: list[tuple[float, float]] = []

    def depth_map(self, wanted: Wanted) -> DepthMap:
        frames, config, _ = wanted
        self.asked.append(config.depth_range)
        baseline = np.linalg.norm((frames[1].cam_from_world - frames[0].cam_from_world)[:3, 3])
        depth = float(np.clip(self.wall * baseline / 0.15, *config.depth_range))
        keypoints = KeypointDepths(torch.zeros(9, 2), torch.full((9,), depth), wanted.size)
        confidence = np.full(wanted.size, 0.5, dtype=np.float32)
        map = np.where(confidence >= config.min_confidence, np.float32(depth), np.float32(0))
        points = np.array([[0.0, 0.0, depth]])
        return DepthMap(map, confidence, points, np.zeros((1, 3), np.uint8), keypoints)


class Blind(Oracle):
    """Finds points and writes no map."""

    def depth_map(self, wanted: Wanted) -> DepthMap:
        found = super().depth_map(wanted)
        return found._replace(depth=np.zeros_like(found.depth))


def with_points(capture: Capture, wall: float, *, seen: bool = True) -> Capture:
    """With a grid of sparse points on a wall at a depth."""
    xyz = np.stack(np.broadcast_arrays(*np.mgrid[-1:1:8j, -1:1:8j], 0.0), axis=-1).reshape(-1, 3)
    xyz = xyz * wall / 4 + [0.08 * wall, 0, wall]
    frames, count = len(capture.frames), len(xyz)
    observed = Observations(
        np.tile(np.arange(count), frames), np.repeat(np.arange(frames), count), np.zeros((0, 2))
    )
    told = observed if seen else Observations.none()
    points = SparsePoints(xyz, np.zeros_like(xyz, np.uint8), np.zeros(count), told)
    return replace(capture, points=points)


@given(
    depths=st.lists(st.floats(0.01, 100), min_size=1, max_size=30), unit=UNITS, metric=st.booleans()
)
def test_a_search_holds_what_is_known_and_scales_with_the_unit(
    depths: list[float], unit: float, metric: bool
) -> None:
    reach = reach_of(depths, metric=metric)
    low, median, high = np.percentile(depths, (2, 50, 98))
    assert reach.near <= low and reach.far >= high
    assert reach.near * reach.unit <= ROOM[0] * 1.001 and reach.far * reach.unit >= ROOM[1] * 0.999
    if not metric:
        assert reach.unit * median == pytest.approx(2.5)
        other = reach_of(np.array(depths) * unit, metric=False)
        assert np.allclose(other, [reach.near * unit, reach.far * unit, reach.unit / unit])
    elif 1 <= median <= 6:
        assert reach.unit == 1


@pytest.mark.parametrize(
    ("wall", "end"), [(0.01, "near"), (0.7, None), (2.5, None), (7.0, None), (90.0, "far")]
)
def test_points_pile_up_at_the_end_that_is_too_near(wall: float, end: str | None) -> None:
    depths = np.clip(np.linspace(0.9, 1.1, 50) * wall, *ROOM)
    assert end_of_pile(depths, Reach(*ROOM)) == end
    assert end_of_pile([], Reach(*ROOM)) is None


@pytest.mark.parametrize("wall", [0.004, 0.3, 2.5, 80.0])
@pytest.mark.parametrize("metric", [True, False])
def test_the_wall_is_found_wherever_it_is(capture: Capture, wall: float, metric: bool) -> None:
    found = Followed(replace(no_sensor(capture), metric=metric))(
        Oracle(wall), VIEWS, PredictConfig()
    )
    assert np.allclose(found.map.depth, wall, rtol=1e-5) and found.piled is None
    assert found.reach.near < wall < found.reach.far
    assert found.map.points[0, 2] == pytest.approx(wall)


def test_a_room_in_metres_is_searched_once_as_ever(capture: Capture) -> None:
    oracle = Oracle(2.5)
    assert Followed(capture)(oracle, VIEWS, PredictConfig()).reach == Reach(*ROOM)
    assert oracle.asked == [ROOM]


def test_a_network_that_finds_no_point_is_asked_once(capture: Capture) -> None:
    class Pointless(Oracle):
        def depth_map(self, wanted: Wanted) -> DepthMap:
            found = super().depth_map(wanted)
            none = torch.zeros_like(found.keypoints.depth)
            return found._replace(keypoints=found.keypoints._replace(depth=none))

    oracle = Pointless(2.5)
    found = Followed(replace(no_sensor(capture), metric=False))(oracle, VIEWS, PredictConfig())
    assert len(oracle.asked) == 1 and found.piled is None


@pytest.mark.parametrize("seen", [True, False])
def test_sparse_points_spare_the_first_look(capture: Capture, seen: bool) -> None:
    known = with_points(replace(no_sensor(capture), metric=False), 0.3, seen=seen)
    oracle = Oracle(0.3)
    found = Followed(known)(oracle, VIEWS, PredictConfig())
    assert len(oracle.asked) == 1 and np.allclose(found.map.depth, 0.3)
    assert farthest_depth(known) == pytest.approx(0.3)
    points = points_in_view(known, 1)
    assert points is not None and np.allclose(points[:, 2], 0.3)


def test_a_range_that_the_capture_states_is_searched_as_part_of_a_room(capture: Capture) -> None:
    for stated, searched in (((0.2, 0.6), (0.06, 1.2)), ((2, 4), (0.5, 10)), ((1, 12), (0.5, 12))):
        ranges = np.tile(stated, (len(capture.frames), 1))
        oracle = Oracle(2.0 if stated[0] > 0.2 else 0.3)
        found = Followed(replace(capture, depth_ranges=ranges))(oracle, VIEWS, PredictConfig())
        assert len(oracle.asked) == 1
        assert found.reach[:2] == pytest.approx(searched)
        assert np.allclose(found.map.depth, oracle.wall)


def test_a_sensor_is_asked_where_points_pile_up(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = np.full(100, 0.3)
    monkeypatch.setattr(search, "depths_of_sensor", lambda *_: measured)
    oracle = Oracle(0.3)
    found = Followed(capture)(oracle, VIEWS, PredictConfig())
    assert len(oracle.asked) == 2 and found.piled is None
    assert found.reach == reach_of(measured, metric=True)
    assert Followed(capture)(Oracle(2.5), VIEWS, PredictConfig()).reach == Reach(*ROOM)


def test_a_range_that_is_asked_for_is_what_is_searched(capture: Capture) -> None:
    oracle = Oracle(80.0)
    found = Asked(capture, (1.0, 4.0))(oracle, VIEWS, PredictConfig())
    assert oracle.asked == [(1.0, 4.0)] and found.piled == "far"


@given(unit=UNITS)
def test_maps_and_views_do_not_depend_on_the_unit(unit: float) -> None:
    capture = replace(orbit(), metric=False)
    other = scaled(capture, unit, metric=False)
    assert guessed_depth(other) == pytest.approx(unit * guessed_depth(capture))
    assert choose_view_sets(other, 3) == choose_view_sets(capture, 3)
    for known in (capture, with_points(capture, 2.0)):
        again = scaled(known, unit, metric=False)
        assert np.allclose(working_depths(again), unit * working_depths(known))
        assert knows_its_scale(again) == knows_its_scale(known) == (known.points is not None)


def test_cameras_that_look_at_one_thing_tell_how_far_it_is() -> None:
    assert guessed_depth(orbit(radius=3.0)) == pytest.approx(3.0, rel=1e-6)
    # Back to back, axes meet behind the cameras: then their spacing is all there is.
    spacing = 2 * 3.0 * np.sin(1 / 12)
    assert guessed_depth(orbit(radius=-3.0)) == pytest.approx(SPACINGS * spacing, rel=1e-6)
    # As little does an axis that was met before the other camera stood there.
    first, second = orbit(count=2, step=0.3).frames.values()
    aside = second.cam_from_world.copy()
    aside[:3, 3] = -aside[:3, :3] @ [1.0, 0, 5.0 + first.cam_from_world[2, 3]]
    pair = Frames.of([first, replace(second, cam_from_world=aside)])
    apart = np.linalg.norm(np.subtract(*_centres(pair)))
    assert guessed_depth(Capture(Path(), pair, {})) == pytest.approx(SPACINGS * apart)


def test_keyframes_are_those_that_see_something_new() -> None:
    around = orbit(radius=2.0, count=60, step=0.02)  # 4 cm and 1.1 degrees a frame
    assert keyframes(around) == [str(id) for id in range(0, 60, 4)]  # 5 % of 2.5 m, as in rooms
    assert keyframes(around, working_depth=100.0) == [str(id) for id in range(0, 60, 7)]  # 8 deg
    again = scaled(around, 50.0, metric=False)  # which is looked at from twice 50 of its units
    assert keyframes(again) == [str(id) for id in range(0, 60, 3)]


def test_a_look_in_another_unit_comes_back_in_the_captures(capture: Capture) -> None:
    frames = [capture.frame(id) for id in ("1", "0", "2")]
    plain = look(Oracle(2.5), frames, PredictConfig(), Reach(0.5, 10.0))  # type: ignore[arg-type]
    other = look(Oracle(2.5), frames, PredictConfig(), Reach(0.5, 10.0, 7.0))  # type: ignore[arg-type]
    assert np.allclose(other.depth, plain.depth) and np.allclose(other.points, plain.points)
    assert torch.allclose(other.keypoints.depth, plain.keypoints.depth)


def test_the_scale_is_found_by_sensor_and_by_hand(capture: Capture, tmp_path: Path) -> None:
    small = scaled(capture, 0.1, metric=False)  # its sensor measured 2.5 m, a wall is at 0.25
    oracle, config = Oracle(2.5), PredictConfig()
    assert depth_seen(oracle, small, config) == pytest.approx(0.25)  # type: ignore[arg-type]
    assert scale_by_sensor(oracle, small, config) == pytest.approx(10)  # type: ignore[arg-type]
    by_points = with_points(small, 0.25)
    assert scale_by_sensor(Oracle(99.0), by_points, config) == pytest.approx(10)  # type: ignore[arg-type]
    file = tmp_path / "measured.txt"
    file.write_text("# tape\n1 10 20 2.5\n2 3.2 4 2.4\n0 5 5 2.6\n")
    assert scale_by_measurements(oracle, small, config, file) == pytest.approx(10)  # type: ignore[arg-type]
    wrong = ("1 10 20", "1 10 20 -3", "1 10 20 inf", "1 999 20 2", "1 nan 2 2", "1 x 20 2", "")
    for text in (*wrong, "nobody 1 1 1"):
        file.write_text(text)
        with pytest.raises(UserError):
            scale_by_measurements(oracle, small, config, file)  # type: ignore[arg-type]
    file.write_text("10 20 2.5")
    with pytest.raises(UserError, match="line 1 is not ID X Y METRES"):
        scale_by_measurements(oracle, small, config, file)  # type: ignore[arg-type]
    file.write_text("1 10 20 2.5")
    with pytest.raises(UserError, match="no depth was found"):
        scale_by_measurements(Blind(2.5), small, config, file)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="no sensor depth"):
        scale_by_sensor(oracle, no_sensor(small), config)  # type: ignore[arg-type]


def test_the_scale_by_points_is_read_where_a_lens_shows_them(capture: Capture) -> None:
    frame, bent = capture.frame("1"), Lens("SIMPLE_RADIAL", (0.5,))
    assert frame.depth_path is not None
    steps = np.tile(1000 + 100 * np.arange(64, dtype=np.uint16), (48, 1))
    Image.fromarray(steps).save(frame.depth_path)
    frame = replace(frame, lens=bent, depth_K=None, cam_from_world=np.eye(4))
    pixels = torch.cartesian_prod(torch.arange(40, 60, 2), torch.arange(10, 40, 3)).double()
    rays = lens_of(frame).unproject(pixels).rays
    xyz = 0.1 * (1 + 0.1 * pixels[:, :1]) * rays / rays[:, 2:]
    seen = Observations(np.arange(len(xyz)), np.zeros(len(xyz), np.int64), pixels.numpy())
    points = SparsePoints(xyz.numpy(), np.zeros((len(xyz), 3), np.uint8), xyz[:, 0].numpy(), seen)
    small = replace(capture, frames=Frames.of([frame]), points=points, metric=False)
    assert scale_by_sensor(Oracle(99.0), small, PredictConfig()) == pytest.approx(10)  # type: ignore[arg-type]


@pytest.mark.parametrize("written", [{"size": (32, 40)}, {"min_confidence": 1.0}])
def test_the_scale_does_not_depend_on_what_is_written(
    capture: Capture, tmp_path: Path, written: dict[str, Any]
) -> None:
    small, config = scaled(capture, 0.1, metric=False), PredictConfig(**written)
    file = tmp_path / "measured.txt"
    file.write_text("1 60 40 2.5\n")  # beyond a map of 32x40
    oracle = Oracle(2.5)
    assert scale_by_measurements(oracle, small, config, file) == pytest.approx(10)  # type: ignore[arg-type]
    assert scale_by_sensor(oracle, small, config) == pytest.approx(10)  # type: ignore[arg-type]


def test_a_verdict_doubts_low_confidence_and_few_points() -> None:
    good = {"confidence": 0.55, "valid_points": 700, "keypoints": 768}
    assert not verdict([good] * 3).doubtful
    low = verdict([good | {"confidence": 0.15}] * 2 + [good])
    assert low.doubtful and "too near to each other or too far apart" in low.line
    assert verdict([good | {"valid_points": 9}] * 2 + [good]).doubtful
    assert "2 view sets" in verdict([good], short=2).line
    assert not verdict([{"status": "kept"}]).doubtful


def no_sensor(capture: Capture) -> Capture:
    frames = [replace(frame, depth_path=None) for frame in capture.frames.values()]
    return replace(capture, frames=Frames.of(frames, capture.frames.folder))


def _centres(frames: Frames) -> np.ndarray:
    return np.array([-p[:3, :3].T @ p[:3, 3] for p in frames.cam_from_world])


def orbit(radius: float = 2.0, count: int = 12, step: float = 1 / 6) -> Capture:
    """Cameras on a circle that look at its centre."""
    K = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
    frames = []
    for number in range(count):
        cos, sin = np.cos(number * step), np.sin(number * step)
        pose = np.eye(4)
        pose[:3, :3] = [[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]]
        pose[2, 3] = radius
        frames.append(Frame(str(number), Path(f"{number}.jpg"), (48, 64), K, pose))
    return Capture(Path("orbit"), Frames.of(frames), {})
