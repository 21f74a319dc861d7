"""Small captures and scenes on disk, and the `deltas` command."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from room_capture import write_scene
from run_command import Run, runner
from small_capture import write_capture

from deltas_geom import PosedViews
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.rooms import render_room

MakeCapture = Callable[..., Path]


@pytest.fixture
def make_capture(tmp_path: Path) -> MakeCapture:
    """A function like `small_capture.write_capture` with a folder of its own."""

    def make(num_frames: int = 4, *, path: Path | None = None, **more: Any) -> Path:
        return write_capture(tmp_path / "capture" if path is None else path, num_frames, **more)

    return make


@pytest.fixture
def capture(make_capture: MakeCapture) -> Capture:
    """Four frames in a row."""
    return open_capture(make_capture())


@pytest.fixture(scope="session")
def scannet_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three scenes of 9 frames, two to train on and one to test on; never written to."""
    root = tmp_path_factory.mktemp("scannet")
    room = render_room(0, num_views=9, image_size=(96, 128))
    # One room, its frames in another order each time: rendering takes longer than the tests.
    for turn, name in enumerate(
        ("scans/scene0000_00", "scans/scene0706_01", "scans_test/scene0707_00")
    ):
        order = torch.arange(9).roll(4 * turn)
        views = PosedViews(*(tensor[order] for tensor in room.views))
        write_scene(root / name, PosedImages(room.images[order], views, room.depth[order]))
    return root


@pytest.fixture
def scannet_copy(scannet_root: Path, tmp_path: Path) -> Path:
    """A copy to break; files that are not touched stay links."""
    copy = tmp_path / "scannet"
    for file in scannet_root.rglob("*.*"):
        target = copy / file.relative_to(scannet_root)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(file)
    return copy


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Run `deltas` with arguments, in this process."""
    return runner(monkeypatch, capfd)
