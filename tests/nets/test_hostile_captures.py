"""Whatever the bytes of a capture's files are: a capture, or one line of error; nothing written."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_capture import write_capture

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.captures.saving import WRITERS, save_capture
from deltas_nets.errors import UserError

IMAGES = (".jpg", ".jpeg", ".png", ".ply.gz")
SAMPLES = ("tum", "robustmvd", "opensfm", "openmvg", "kapture", "colmap_text_kapture")
"""Of other programs; their metadata is copied to be broken, their images are linked."""
SMALL = 2**20
"""Bytes of what is broken; larger files only slow the test down."""


def full_capture(folder: Path) -> Capture:
    """A capture with everything that a format can hold."""
    capture = open_capture(write_capture(folder, num_frames=3))
    seen = Observations(np.array([0, 1, 1]), np.array([0, 1, 2]), np.full((3, 2), 9.5))
    points = SparsePoints(
        np.array([[0.0, 0, 2.5], [0.1, 0.2, 2.5]]), np.zeros((2, 3), np.uint8), np.ones(2), seen
    )
    return replace(capture, points=points)


def bent(capture: Capture) -> Capture:
    lens = Lens("OPENCV", (0.1, 0.01, 0.001, 0.002))
    frames = [replace(frame, lens=lens) for frame in capture.frames.values()]
    return replace(capture, frames=Frames.of(frames, capture.frames.folder))


@st.composite
def damages(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """Bytes cut off, turned, put in, or others in the place of some."""
    kind = draw(st.sampled_from(("cut", "flip", "insert", "replace", "empty", "digits")))
    place, noise = draw(st.floats(0, 1)), draw(st.binary(min_size=1, max_size=12))
    word = draw(st.sampled_from((b"nan", b"-1", b"1e999", b"9" * 30, b"[", b'"', b"\n", b"../")))

    def damage(data: bytes) -> bytes:
        at = int(place * len(data))
        if kind == "cut":
            return data[:at]
        if kind == "flip":
            return data[:at] + bytes(b ^ 255 for b in data[at : at + 1]) + data[at + 1 :]
        if kind == "insert":
            return data[:at] + noise + data[at:]
        if kind == "replace":
            return data[:at] + noise + data[at + len(noise) :]
        if kind == "digits":
            return data[:at] + word + data[at + len(word) :]
        return b""

    return damage


def check_damaged(folder: Path, file: Path, damage: Callable[[bytes], bytes]) -> None:
    data = file.read_bytes()
    before = sorted(os.listdir(folder))
    try:
        file.write_bytes(damage(data))
        capture = open_capture(folder)
        assert capture.frames
        for frame in capture.frames.values():
            assert np.isfinite(frame.K).all() and np.isfinite(frame.cam_from_world).all()
    except UserError as error:
        assert len(str(error)) < 1000, error  # noqa: PT017
    finally:
        file.write_bytes(data)
    assert sorted(os.listdir(folder)) == before


def texts_of(folder: Path) -> list[Path]:
    """Files that say something about the images."""
    files = [file for file in sorted(folder.rglob("*")) if file.is_file() and not file.is_symlink()]
    return [file for file in files if file.suffix.lower() not in IMAGES]


@pytest.fixture(scope="module", params=WRITERS)
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile")
    capture = full_capture(folder / "in")
    save_capture(
        capture if request.param == "scannet" else bent(capture), folder / "out", request.param
    )
    return folder / "out"


@given(data=st.data(), damage=damages())
def test_damaged_files_of_our_formats(
    written: Path, data: st.DataObject, damage: Callable[[bytes], bytes]
) -> None:
    check_damaged(written, data.draw(st.sampled_from(texts_of(written))), damage)


@pytest.fixture(scope="module", params=SAMPLES)
def sample(
    request: pytest.FixtureRequest, shared_data: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    source = shared_data / "formats" / request.param
    folder = tmp_path_factory.mktemp("sample") / "it"
    for file in source.rglob("*"):
        if file.is_file():
            target = folder / file.relative_to(source)
            target.parent.mkdir(parents=True, exist_ok=True)
            if file.suffix.lower() in IMAGES or file.stat().st_size > SMALL:
                target.symlink_to(file)
            else:
                shutil.copyfile(file, target)
    return folder


@pytest.mark.shared
@given(data=st.data(), damage=damages())
def test_damaged_files_of_other_programs(
    sample: Path, data: st.DataObject, damage: Callable[[bytes], bytes]
) -> None:
    check_damaged(sample, data.draw(st.sampled_from(texts_of(sample))), damage)
