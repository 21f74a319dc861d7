"""View sets: a file that names them, a rule that chooses them, and the check of both."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from run_command import Run, assert_one_line
from small_capture import write_view_sets

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.sets_file import sets_file
from deltas_nets.captures.usable import lone_frames, usable_view_sets
from deltas_nets.captures.view_choice import choose_view_sets, spread_sources
from deltas_nets.captures.view_sets import ViewSet, check_frames, read_view_sets
from deltas_nets.errors import UserError
from deltas_nets.outputs.summary import recorded_view_sets

MakeCapture = Callable[..., Path]


def row_of_cameras(centres: np.ndarray, *, turns: np.ndarray | None = None) -> Capture:
    """Frames without files at ``centres`` (N, 3), turned about y by ``turns`` (N,) rad."""
    K = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
    frames = []
    for id, centre in enumerate(centres):
        turn = 0.0 if turns is None else float(turns[id])
        cos, sin = np.cos(turn), np.sin(turn)
        pose = np.eye(4)
        pose[:3, :3] = [[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]]
        pose[:3, 3] = -pose[:3, :3] @ centre
        frames.append(Frame(str(id), Path(f"{id}.jpg"), (48, 64), K, pose))
    return Capture(Path("capture"), Frames.of(frames), {})


def along_x(*positions: float) -> Capture:
    return row_of_cameras(np.array([[x, 0.0, 0.0] for x in positions]))


def test_sets_are_read_in_order(capture: Capture, tmp_path: Path) -> None:
    path = write_view_sets(
        tmp_path, [{"anchor": 2, "sources": [1, 3]}, {"anchor": 0, "sources": [1], "note": "x"}]
    )
    assert read_view_sets(path, capture) == (ViewSet("2", ("1", "3")), ViewSet("0", ("1",)))


def test_ids_may_be_strings(capture: Capture, tmp_path: Path) -> None:
    sets = write_view_sets(tmp_path, [{"anchor": "2", "sources": ["1", 3]}])
    assert read_view_sets(sets, capture) == (ViewSet("2", ("1", "3")),)


def test_a_file_that_is_missing_or_binary_is_one_line(capture: Capture, tmp_path: Path) -> None:
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    for file in (tmp_path / "missing.json", tmp_path / "binary.json"):
        with pytest.raises(UserError) as error:
            read_view_sets(file, capture)
        assert error.value.where == file and error.value.remedy


@pytest.mark.parametrize("form", ["utf-8-sig", "utf-16"])
def test_a_file_may_say_how_its_text_is_coded(capture: Capture, tmp_path: Path, form: str) -> None:
    (tmp_path / "sets.json").write_bytes('[{"anchor": 2, "sources": [1]}]'.encode(form))
    assert read_view_sets(tmp_path / "sets.json", capture) == (ViewSet("2", ("1",)),)


def test_a_set_that_names_a_lost_pose_is_an_error(make_capture: MakeCapture) -> None:
    folder = make_capture()
    (folder / "pose" / "1.txt").write_text("nan " * 16)
    path = write_view_sets(folder, [{"anchor": 0, "sources": [1]}])
    with pytest.raises(UserError, match=r"frame 1 is not finite, .*1.txt: repair it or take"):
        read_view_sets(path, open_capture(folder))


def test_an_anchor_may_stand_alone_with_sensor_depth(capture: Capture, tmp_path: Path) -> None:
    path = write_view_sets(tmp_path, [{"anchor": 1, "sources": []}])
    assert lone_frames(capture, path, None).view_sets == (ViewSet("1", ()),)


def test_views_are_chosen_for_frames_of_which_the_capture_says_nothing(
    capture: Capture, capfd: pytest.CaptureFixture[str]
) -> None:
    stated = {"0": ("2",), "2": (), "3": ("gone",)}
    found = usable_view_sets(replace(capture, sources=stated), None, 3).view_sets
    chosen = dict(choose_view_sets(capture, 3))
    assert dict(found) == {"0": ("2",), "1": chosen["1"], "3": chosen["3"]}
    assert "views are chosen where the capture states none that are there: 1, 3" in (
        capfd.readouterr().err
    )
    nobody = dict.fromkeys(capture.frames, ())
    with pytest.raises(UserError, match="no view goes with it"):
        usable_view_sets(replace(capture, sources=nobody), None, 3)


def test_frames_that_sets_name_are_checked_and_others_are_not(make_capture: MakeCapture) -> None:
    folder = make_capture()
    path = folder / "color" / "3.jpg"
    path.write_bytes(path.read_bytes()[:-300])
    capture = open_capture(folder)
    check_frames(capture, [ViewSet("0", ("1", "2"))], with_depth=True)
    with pytest.raises(UserError, match=r"truncated\), .*color/3.jpg: copy"):
        check_frames(capture, [ViewSet("0", ("1", "3"))])


def test_damaged_sensor_depth_is_found_where_it_is_used(make_capture: MakeCapture) -> None:
    folder = make_capture()
    path = folder / "depth" / "0.png"
    path.write_bytes(path.read_bytes()[:60])
    capture = open_capture(folder)
    check_frames(capture, [ViewSet("0", ("1", "2"))])
    with pytest.raises(UserError, match=r"depth/0.png"):
        check_frames(capture, [ViewSet("0", ("1", "2"))], with_depth=True)


def test_a_pose_that_is_not_finite_is_found() -> None:
    capture = along_x(0.0, 0.2)
    capture.frame(1).cam_from_world[0, 3] = np.nan
    with pytest.raises(UserError, match=r"pose of frame 1 is not finite, 1.jpg"):
        check_frames(capture, [ViewSet("1", ("0",))])


def test_good_baselines_are_preferred_to_short_and_long_ones() -> None:
    capture = along_x(0.0, 0.02, 0.2, 0.6)
    (chosen,) = choose_view_sets(capture, 2, anchors=[0])
    assert chosen == ViewSet("0", ("2",))


def test_working_depth_scales_the_baseline() -> None:
    capture = along_x(0.0, 0.02, 0.2, 1.2)
    assert choose_view_sets(capture, 2, anchors=[0], working_depth=0.25)[0].sources == ("1",)
    assert choose_view_sets(capture, 2, anchors=[0], working_depth=15.0)[0].sources == ("3",)


def test_sources_lie_on_both_sides_of_the_anchor() -> None:
    capture = along_x(-0.24, -0.2, 0.0, 0.2, 0.24)
    (chosen,) = choose_view_sets(capture, 3, anchors=[2])
    assert len({int(source) < 2 for source in chosen.sources}) == 2


@pytest.mark.parametrize(("sideways", "ahead"), [(0.003, 0.04), (0.006, 0.03)])
def test_of_a_camera_that_walks_ahead_a_source_is_near_enough_to_see_what_the_anchor_sees(
    sideways: float, ahead: float
) -> None:
    steps = np.arange(20)
    capture = row_of_cameras(np.stack([sideways * steps**2, 0 * steps, ahead * steps], axis=-1))
    (chosen,) = choose_view_sets(capture, 3, anchors=[0])
    first, second = map(int, chosen.sources)
    # By baseline alone the second would be farther than the first, and see less still.
    assert second < first


def test_as_many_views_as_are_wanted_go_together() -> None:
    ring = np.linspace(0, 2 * np.pi, 70, endpoint=False)
    capture = row_of_cameras(0.3 * np.stack([np.cos(ring), np.sin(ring), 0 * ring], axis=-1))
    for wanted in (48, 49, 50, 60, 70, 80):
        (chosen,) = choose_view_sets(capture, wanted, anchors=[0])
        assert len(chosen.sources) == min(wanted - 1, 69)


def test_a_camera_that_looks_elsewhere_is_not_chosen() -> None:
    centres = np.array([[0.0, 0, 0], [0.2, 0, 0], [-0.12, 0, 0]])
    capture = row_of_cameras(centres, turns=np.array([0.0, np.pi, 0.1]))
    assert choose_view_sets(capture, 3, anchors=[0]) == (ViewSet("0", ("2",)),)


def test_portrait_and_landscape_do_not_go_together() -> None:
    sideways = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    upright = along_x(*0.1 * np.arange(10)).frames.values()
    frames = [
        replace(frame, cam_from_world=sideways @ frame.cam_from_world) if place % 2 else frame
        for place, frame in enumerate(upright)
    ]
    for anchor, sources in choose_view_sets(Capture(Path("capture"), Frames.of(frames), {}), 3):
        assert len(sources) == 2 and {int(id) % 2 for id in (anchor, *sources)} == {int(anchor) % 2}


def test_without_an_acceptable_source_the_best_is_taken() -> None:
    capture = along_x(0.0, 3.0, 5.0)
    assert choose_view_sets(capture, 2, anchors=[0]) == (ViewSet("0", ("1",)),)
    still = along_x(1.0, 1.0)
    assert choose_view_sets(still, 3) == (ViewSet("0", ("1",)), ViewSet("1", ("0",)))


def test_a_distant_origin_changes_nothing() -> None:
    positions = np.cumsum(np.random.default_rng(1).uniform(-0.1, 0.15, (30, 3)), axis=0)
    near = choose_view_sets(row_of_cameras(positions), 4)
    far = choose_view_sets(row_of_cameras(positions + np.array([5e5, 2e5, 0])), 4)
    assert near == far


def test_a_turned_world_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    positions = np.cumsum(rng.uniform(-0.1, 0.15, (30, 3)), axis=0)
    capture = row_of_cameras(positions, turns=np.cumsum(rng.uniform(-0.3, 0.3, 30)))
    new_from_world = np.eye(4)
    new_from_world[:3, :3] = [[0.0, 0.6, 0.8], [0.0, -0.8, 0.6], [1.0, 0.0, 0.0]]
    frames = [
        replace(frame, cam_from_world=frame.cam_from_world @ new_from_world)
        for frame in capture.frames.values()
    ]
    turned = Capture(capture.path, Frames.of(frames), {})
    assert choose_view_sets(turned, 4) == choose_view_sets(capture, 4)


def test_one_frame_or_one_view_is_an_error(capture: Capture) -> None:
    with pytest.raises(UserError, match=r"one frame .*capture: depth from views"):
        choose_view_sets(along_x(0.0), 3)
    with pytest.raises(UserError, match=r"1 views are too few, --views: use 2"):
        choose_view_sets(capture, 1)


def test_two_thousand_frames_take_seconds() -> None:
    steps = np.random.default_rng(0).normal(0, 0.05, (2000, 3))
    capture = row_of_cameras(np.cumsum(steps, axis=0))
    start = time.process_time()
    sets = choose_view_sets(capture, 7)
    assert len(sets) == 2000
    assert time.process_time() - start < 10


@pytest.mark.shared
@pytest.mark.parametrize("name", ["hololens", "sevenscenes_reg"])
def test_chosen_sets_resemble_those_made_by_hand(shared_data: Path, name: str) -> None:
    capture = open_capture(shared_data / name)
    given = read_view_sets(shared_data / name / "view_sets.json", capture)
    check_frames(capture, given[:2], with_depth=True)
    chosen = choose_view_sets(capture, 3, anchors=[view_set.anchor for view_set in given])

    def mean_baseline(sets: tuple[ViewSet, ...]) -> float:
        """Metres, over the first two sources."""
        lengths = []
        for view_set in sets:
            world_from_anchor = np.linalg.inv(capture.frame(view_set.anchor).cam_from_world)
            for source in view_set.sources[:2]:
                source_from_anchor = capture.frame(source).cam_from_world @ world_from_anchor
                lengths.append(float(np.linalg.norm(source_from_anchor[:3, 3])))
        return float(np.mean(lengths))

    assert mean_baseline(chosen) == pytest.approx(mean_baseline(given), rel=0.25)
    assert all(len(view_set.sources) == 2 for view_set in chosen)


def test_a_file_of_view_sets_may_lie_in_the_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    capture, file = Path("capture"), Path("sets.json")
    capture.mkdir()
    (capture / "transforms.json").touch()
    assert sets_file(file, capture) == file  # which is nowhere, as errors say
    (capture / file).touch()
    assert sets_file(file, capture) == sets_file(file, capture / "transforms.json")
    assert sets_file(file, capture) == capture / file
    file.touch()
    assert sets_file(file, capture) == file


def test_depth_and_evaluation_find_the_same_view_sets_in_a_capture(
    make_capture: MakeCapture, run: Run, tmp_path: Path
) -> None:
    """Their names are those of the file, wherever the command is started."""
    path = make_capture()
    (path / "sets.json").write_text('[{"anchor": 2, "sources": [1, 3]}]')
    asked = (path, "--view-sets", "sets.json", "--weights", "plane-sweep")
    done = run("depth", *asked, "--no-page", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    assert recorded_view_sets(tmp_path / "out") == (ViewSet("2", ("1", "3")),)
    done = run("evaluate", *asked, "--json", tmp_path / "scores.json")
    assert done.code == 0, done.err
    frames = json.loads((tmp_path / "scores.json").read_text())["frames"]
    assert [(frame["frame"], frame["sources"]) for frame in frames] == [("2", "1 3")]
    refused = run("depth", path, "--view-sets", "none.json", "--out", tmp_path / "none")
    assert_one_line(refused, "does not exist, in the capture neither", "--view-sets none.json")


def test_a_source_repeats_every_one_that_was_chosen_and_not_the_last_alone() -> None:
    offsets = np.array([[1.0, 0, 0], [1.05, 0, 0], [-1, 0, 0], [0, 1, 0]])  # the first two alike
    assert spread_sources(np.array([0.0, -0.1, -0.2, -1.0]), offsets, 3) == [0, 2, 3]
