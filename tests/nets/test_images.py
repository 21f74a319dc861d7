"""Images: found broken before anything is written, and decoded once a run."""

from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFile
from run_command import Run

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.images import ImageMemory, decode, header_of_whole_file
from deltas_nets.errors import UserError
from deltas_nets.terminal import without_warnings_of_pillow

MakeCapture = Callable[..., Path]


@pytest.fixture
def decodes(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often Pillow decoded the pixels of each file."""
    counts: Counter[str] = Counter()
    load = ImageFile.ImageFile.load

    def counted(image: ImageFile.ImageFile) -> object:
        if image.tile and image.filename:  # or it is decoded already
            counts[Path(image.filename).name] += 1
        return load(image)

    monkeypatch.setattr(ImageFile.ImageFile, "load", counted)
    return counts


@pytest.mark.parametrize("command", ["depth", "evaluate"])
def test_every_image_is_decoded_once(
    run: Run, make_capture: MakeCapture, tmp_path: Path, decodes: Counter[str], command: str
) -> None:
    capture = make_capture()
    flags = ["--out", tmp_path / "out", "--depth-range", 0.5, 10, "--no-page"]
    out = flags if command == "depth" else []
    assert run(command, capture, *out).code == 0
    names = [f"{id}.jpg" for id in range(4)]
    names += [f"{id}.png" for id in range(4)] if command == "evaluate" else []
    assert decodes == Counter(names)


def test_whole_files_are_told_without_decoding(tmp_path: Path, decodes: Counter[str]) -> None:
    pixels = Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
    for name in ("a.jpg", "a.png"):
        pixels.save(tmp_path / name)
        assert header_of_whole_file(tmp_path / name) == ((48, 64), "RGB")
    assert not decodes


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_no_part_of_a_file_is_taken_for_a_whole_one(
    tmp_path: Path, suffix: str, share: float
) -> None:
    pixels = Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
    file = tmp_path / f"a.{suffix}"
    pixels.save(file)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    assert header_of_whole_file(file) is None


def test_a_png_with_a_changed_byte_is_not_whole(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    Image.fromarray(np.full((48, 64), 2500, np.uint16)).save(file)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    assert header_of_whole_file(file) is None


def test_what_stands_behind_a_jpeg_is_no_obstacle(capture: Capture, decodes: Counter[str]) -> None:
    frame = capture.frame(0)
    frame.image_path.write_bytes(frame.image_path.read_bytes() + b"written by a phone")
    frame.check_image()
    assert decodes == {"0.jpg": 1}  # only decoding can tell


def test_the_memory_keeps_what_was_used_last() -> None:
    memory, read = ImageMemory(capacity=200), []

    def reader(name: str) -> Callable[[], np.ndarray]:
        return lambda: read.append(name) or np.zeros(100, np.uint8)  # type: ignore[func-returns-value]

    for name in ("a", "b", "a", "c", "a", "b"):
        memory.get(Path(name), reader(name))
    assert read == ["a", "b", "c", "b"]


def test_an_image_larger_than_the_memory_is_read_all_the_same(capture: Capture) -> None:
    frame = capture.remembering(capacity=1).frame(0)
    assert np.array_equal(frame.read_image(), capture.frame(0).read_image())


def test_a_frame_without_depth_says_so(capture: Capture) -> None:
    blind = replace(capture.frame(0), depth_path=None)
    for read in (blind.check_depth, blind.read_depth):
        with pytest.raises(UserError, match="frame 0 has no sensor depth"):
            read()


def test_a_damaged_tiff_is_told_in_our_words_alone(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file, pixels = tmp_path / "image.tiff", np.random.default_rng(0).integers(0, 255, (60, 60, 3))
    Image.fromarray(pixels.astype(np.uint8)).save(file, compression="tiff_deflate")
    whole = file.read_bytes()
    file.write_bytes(whole[:8] + bytes(2000) + whole[2008:])
    for silent in (True, False):
        quiet = without_warnings_of_pillow() if silent else nullcontext()
        with quiet, pytest.raises(UserError, match="cannot be decoded"):
            decode(file, remedy="copy it again")
        assert ("ZIPDecode" in capfd.readouterr().err) is not silent  # and is as before after it
