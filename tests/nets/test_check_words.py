"""Cures are told in the words of the capture's files: done to a file literally, they mend it."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from room_capture import write_scene

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.check.axes import ORDINALS
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.image_sizes import wrong_sizes
from deltas_nets.check.judging import judge_matches
from deltas_nets.check.matched import Matched, match_capture
from deltas_nets.check.quick import quick_findings
from deltas_nets.rooms import render_room
from deltas_nets.weights_file import load_model

Change = Callable[[np.ndarray], np.ndarray]
SIZE = (192, 256)
CAMERA = ("fl_x", "fl_y", "cx", "cy", "w", "h")
FLIP = np.diag([1.0, -1, -1, 1])


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Matched]:
    """A transforms.json, and matches of its images."""
    folder = tmp_path_factory.mktemp("room")
    write_scene(folder / "scannet", render_room(3, num_views=6, image_size=SIZE))
    for depth in (folder / "scannet" / "depth").iterdir():
        depth.unlink()
    save_capture(open_capture(folder / "scannet"), folder / "whole", to="transforms")
    rewritten(folder / "whole", _with_one_camera, folder / "whole")
    return folder / "whole", match_capture(open_capture(folder / "whole"), load_model())


def _with_one_camera(content: dict) -> None:
    for frame in content["frames"]:
        content |= {key: frame.pop(key) for key in CAMERA if key in frame}


def rewritten(whole: Path, change: Callable[[dict], None], to: Path) -> Path:
    """A folder with another transforms.json beside the same images."""
    to.mkdir(exist_ok=True)
    if not (to / "images").exists():
        (to / "images").symlink_to(whole / "images")
    content = json.loads((whole / "transforms.json").read_text())
    change(content)
    (to / "transforms.json").write_text(json.dumps(content))
    return to


def of_matrices(change: Change) -> Callable[[dict], None]:
    def changed(content: dict) -> None:
        for frame in content["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    return changed


def literally(cure: str) -> Change:
    """What a cure says to do to a camera-to-world matrix, and nothing but that."""

    def done(pose: np.ndarray) -> np.ndarray:
        for step in cure.split(" (")[0].split(", then "):
            pose = _step(step, pose)
        return pose

    return done


def _step(step: str, pose: np.ndarray) -> np.ndarray:
    if step == "invert each pose":
        return np.linalg.inv(pose)
    if step.startswith("negate the second and third column"):
        return pose * [1, -1, -1, 1]
    if step.startswith("negate its third row"):
        return pose * [[1], [1], [-1], [1]]
    if step.startswith("transpose the rotation of each camera-to-world matrix"):
        return np.block([[pose[:3, :3].T, pose[:3, 3:]], [pose[3:]]])
    columns = step.removeprefix("make the columns of camera-to-world ").split(", ")
    assert len(columns) == 3, step
    made = pose.copy()
    for place, words in enumerate(columns):
        *minus, _, ordinal = words.split(" ")
        made[:, place] = pose[:, ORDINALS.index(ordinal)] * (-1 if minus else 1)
    return made


def transposed(pose: np.ndarray) -> np.ndarray:
    return np.block([[pose[:3, :3].T, pose[:3, 3:]], [pose[3:]]])


@pytest.mark.parametrize(
    ("plant", "cause", "words"),
    [
        (lambda pose: pose @ FLIP, Fault.OPENCV_AXES, "OpenCV"),
        (np.linalg.inv, Fault.POSES_INVERTED, "inverted"),
        (lambda pose: np.linalg.inv(pose @ FLIP), Fault.POSES_INVERTED, "OpenCV's axes"),
        (transposed, Fault.ROTATIONS_INVERTED, "rotations"),
        (lambda pose: pose[:, [1, 2, 0, 3]], Fault.OTHER_AXES_THAN_OPENGL, "x up, y backward"),
    ],
)
def test_cures_of_opengls_poses_mend_the_file(
    plant: Change, cause: Fault, words: str, room: tuple[Path, Matched], tmp_path: Path
) -> None:
    whole, matched = room
    planted = rewritten(whole, of_matrices(plant), tmp_path)
    (found,) = judge_matches(open_capture(planted), matched)[0]
    assert found.cause is cause and found.mend is not None
    assert words in f"{found.cause.value} {found.evidence} {found.cure}"
    assert judge_matches(found.mend(open_capture(planted)), matched)[0] == []
    cured = rewritten(planted, of_matrices(literally(found.cure)), planted)
    assert judge_matches(open_capture(cured), matched)[0] == []


def stated(found: Finding) -> dict[str, float]:
    """The camera that a cure says to write, in words of transforms.json."""
    words = found.cure.rpartition("fx ")[2].split()
    fx, fy, cx, cy = (float(words[place]) for place in (0, 2, 4, 6))
    return {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}


def findings(capture: Capture, matched: Matched) -> list[Finding]:
    return [*quick_findings(capture), *judge_matches(capture, matched)[0]]


@pytest.mark.parametrize("factor", [{"fl_x": 0.5, "fl_y": 0.5}, {"fl_x": 2, "cx": 2, "cy": 2}])
def test_cures_of_K_have_the_files_principal_point(
    factor: dict[str, float], room: tuple[Path, Matched], tmp_path: Path
) -> None:
    whole, matched = room
    if "cx" in factor:
        factor = factor | {"fl_y": 2}

    def change(content: dict) -> None:
        content |= {key: content[key] * by for key, by in factor.items()}

    given = json.loads((whole / "transforms.json").read_text())
    planted = rewritten(whole, change, tmp_path)
    found = findings(open_capture(planted), matched)[0]
    right = stated(found)
    assert right == pytest.approx({key: given[key] for key in right}, rel=0.03)
    assert right["cx"] == pytest.approx(given["cx"], abs=1e-3)
    cured = rewritten(planted, lambda content: content.update(right), planted)
    assert findings(open_capture(cured), matched) == []


def test_the_cure_of_an_image_of_another_size_has_the_files_principal_point(
    room: tuple[Path, Matched], tmp_path: Path
) -> None:
    whole, _ = room
    capture = open_capture(rewritten(whole, lambda _: None, tmp_path))
    (tmp_path / "images").unlink()
    (tmp_path / "images").mkdir()
    for place, frame in enumerate(capture.frames.values()):
        size = (SIZE[1] // 2, SIZE[0] // 2) if place == 2 else SIZE[::-1]
        image = Image.open(whole / frame.image_path.relative_to(tmp_path))
        image.resize(size).save(tmp_path / frame.image_path.relative_to(tmp_path))
    (found,) = wrong_sizes(open_capture(tmp_path))
    given = json.loads((whole / "transforms.json").read_text())
    right = stated(found)
    assert right == pytest.approx({key: given[key] / 2 for key in right}, abs=1e-3)
