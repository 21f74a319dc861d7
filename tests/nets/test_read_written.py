"""Readers of other programs' layouts: what they read is what was written, whatever is broken."""

import contextlib
import os
import shutil
import struct
import sys
import time
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from small_capture import write_capture
from written_captures import NUM, WRITERS, Scene, Written, make_scene, tum
from written_data_sets import DATA_SETS

from deltas_nets.captures.camera_words import Intrinsics
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.errors import UserError

ALL = {**WRITERS, **DATA_SETS}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


def _relative(poses: np.ndarray) -> np.ndarray:
    return poses @ np.linalg.inv(poses[0])


@pytest.mark.parametrize("layout", ALL)
def test_a_capture_is_read_as_it_was_written(layout: str, scene: Scene, tmp_path: Path) -> None:
    written = ALL[layout](tmp_path / "capture", scene)
    capture = open_capture(written.path)
    frames = [capture.frame(id) for id in written.ids]
    assert capture.layout.split(",")[0] == layout
    assert (len(capture.frames), capture.lost, capture.metric) == (NUM, {}, written.metric)
    assert len(capture.doubts) == written.doubts
    poses = np.stack([frame.cam_from_world for frame in frames])
    assert np.allclose(_relative(poses), _relative(scene.cam_from_world), rtol=0, atol=2e-6)
    for frame, depth in zip(frames, scene.depths, strict=True):
        assert np.allclose(frame.K, written.K, rtol=1e-6, atol=0)
        assert (frame.lens and tuple(frame.lens)) == written.lens
        frame.check_image() if frame.lens is None else None
        assert (frame.depth_path is not None) == written.depth
        if written.depth:
            frame.check_depth()
            # Half floats hold 11 bits.
            assert np.allclose(frame.read_depth(), depth, rtol=5e-4, atol=0)


def test_polycams_images_stand_in_for_corrected_ones_with_a_warning(
    scene: Scene, tmp_path: Path
) -> None:
    keyframes = WRITERS["Polycam"](tmp_path, scene).path / "keyframes"
    (keyframes / "corrected_images").rename(keyframes / "images")
    capture = open_capture(tmp_path)
    assert len(capture.frames) == NUM and "corrected_images is missing" in capture.doubts[-1]


@pytest.mark.parametrize("named", ["", "keyframes"])
def test_polycams_cameras_without_images_are_told_as_such(
    scene: Scene, tmp_path: Path, named: str
) -> None:
    keyframes = WRITERS["Polycam"](tmp_path, scene).path / "keyframes"
    shutil.rmtree(keyframes / "corrected_images")
    with pytest.raises(UserError, match="no folder of their images") as error:
        open_capture(tmp_path / named)
    assert error.value.where == keyframes / "corrected_images"


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes on Linux alone")
def test_polycams_names_that_are_no_text_are_told(scene: Scene, tmp_path: Path) -> None:
    folder = ALL["Polycam"](tmp_path / "scan", scene).path
    first = min(path.stem for path in folder.rglob("*.json"))
    for file in list(folder.rglob(f"{first}.*")):
        file.rename(file.with_name(os.fsdecode(b"a\xff") + file.suffix))
    with pytest.raises(UserError, match="an image cannot be called"):
        open_capture(folder)


def test_points_and_their_observations_are_read(scene: Scene, tmp_path: Path) -> None:
    for layout, pixels in {
        "OpenSfM": [[47.5, 15.5]],
        "OpenMVG": [[47.5, 15.5]],
        "kapture": [],
    }.items():
        points = open_capture(WRITERS[layout](tmp_path / layout, scene).path).points
        assert points is not None
        assert points.xyz.tolist() == [[1, 2, 3]]
        assert points.seen.pixels.tolist() == pixels


def test_the_pairs_and_depths_of_mvsnet_are_read(scene: Scene, tmp_path: Path) -> None:
    capture = open_capture(WRITERS["MVSNet"](tmp_path / "a", scene).path)
    assert capture.sources is not None and capture.depth_ranges is not None
    assert capture.sources["00000003"] == ("00000001", "00000000")
    assert np.allclose(capture.depth_ranges, [[0.5, 5.5]] * NUM)


@pytest.mark.parametrize(
    ("stated", "far"), [("0.5 0.1", 0.5 + 0.1 * 191), ("0.5 0.1 51", 5.5), ("0.5 0.1 51 6", 6.0)]
)
def test_mvsnets_depths_end_at_the_last_of_its_planes(
    scene: Scene, tmp_path: Path, stated: str, far: float
) -> None:
    folder = WRITERS["MVSNet"](tmp_path / "a", scene).path
    for file in (folder / "cams").iterdir():
        file.write_text(file.read_text().replace("0.5 0.1 51 5.5", stated))
    ranges = open_capture(folder).depth_ranges
    assert ranges is not None and np.allclose(ranges, [[0.5, far]] * NUM)


def test_intrinsics_are_taken_from_the_user_first(scene: Scene, tmp_path: Path) -> None:
    stated = Intrinsics.parse("70 71 30 20")
    for layout in ("TUM RGB-D", "Polycam"):
        path = WRITERS[layout](tmp_path / layout, scene).path
        frame = open_capture(path, intrinsics=stated).frames.at(0)
        assert np.array_equal(frame.K, stated.K) and frame.lens is None


def test_a_file_of_intrinsics_that_is_refused_is_not_asked_where_the_user_states_them(
    scene: Scene, tmp_path: Path
) -> None:
    stated, corner = Intrinsics.parse("70 71 -30 -20"), "70 0 -30 0 71 -20 0 0 1"
    demon = WRITERS["DeMoN"](tmp_path / "demon", scene).path
    exported = write_capture(tmp_path / "exported")
    files = [exported / "intrinsic" / f"intrinsic_{of}.txt" for of in ("color", "depth")]
    for file in (demon / "cam.txt", *files):
        file.write_text(corner)
    for path in (demon, exported):
        with pytest.raises(UserError) as error:
            open_capture(path)
        assert "--intrinsics" in error.value.remedy
        frame = open_capture(path, intrinsics=stated).frames.at(0)
        assert np.array_equal(frame.K, stated.K) and frame.lens is None and frame.depth_K is None


def test_tum_without_a_camera_names_the_option(scene: Scene, tmp_path: Path) -> None:
    (tum(tmp_path / "walk", scene).path / "intrinsics.txt").unlink()
    with pytest.raises(UserError) as error:
        open_capture(tmp_path / "walk")
    assert "--intrinsics freiburg1" in error.value.remedy


def test_tum_without_poses_says_so_whether_its_camera_is_known_or_not(
    scene: Scene, tmp_path: Path
) -> None:
    for name in ("freiburg1", "walk"):
        folder = tum(tmp_path / name, scene).path
        for file in ("intrinsics.txt", "groundtruth.txt"):
            (folder / file).unlink()
        with pytest.raises(UserError) as error:
            open_capture(folder)
        assert "permissions" not in error.value.remedy


def test_tum_says_what_is_missing_and_does_not_guess_poses(scene: Scene, tmp_path: Path) -> None:
    folder = tum(tmp_path / "walk", scene).path
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(lines[:4] + lines[5:]))
    capture = open_capture(folder)
    # Half of frame 1's poses are gone: the next one is 0.2 s away.
    assert {id: lost.reason for id, lost in capture.lost.items()} == {"100.200000": "no pose"}
    assert any(doubt.startswith("1 of 5 images") for doubt in capture.doubts)


def _used(path: Path) -> Capture | None:
    """Whatever is asked of a capture ends in an answer or in a `UserError`."""
    try:
        capture = open_capture(path)
    except UserError:
        return None
    for frame in capture.frames.values():
        assert np.isfinite(frame.K).all() and np.isfinite(frame.cam_from_world).all()
        for ask in (frame.check_image, frame.check_depth):
            with contextlib.suppress(UserError):
                ask()
    return capture


def _broken(data: bytes, rng: np.random.Generator) -> list[bytes]:
    """The same bytes cut, emptied, flipped, and with numbers that nobody expects."""
    flipped = []
    for count in (1, 3, 30):
        bytes_ = np.frombuffer(data, np.uint8).copy()
        places = rng.integers(0, len(bytes_), count)
        bytes_[places] = rng.integers(0, 256, count)
        flipped.append(bytes_.tobytes())
    cuts = [data[: len(data) * part // 8] for part in (0, 1, 4, 7)]
    digits = [at for at, byte in enumerate(data[:4000]) if chr(byte).isdigit()]
    odd = []
    for word in (b"nan", b"-1", b"1e999", b"9" * 400, b'"x"', b"[]", b"null", b"0"):
        if digits:
            at = int(rng.choice(digits))
            odd.append(data[:at] + word + data[at + 1 :])
    return [*cuts, *flipped, *odd, b"\xff\xfe\x00", b"[" * 100_000, b"{}"]


@pytest.mark.parametrize("layout", ALL)
def test_broken_files_end_in_one_clear_line(layout: str, scene: Scene, tmp_path: Path) -> None:
    written = ALL[layout](tmp_path / "capture", scene)
    rng = np.random.default_rng(sum(layout.encode()))
    files = sorted(file for file in (tmp_path / "capture").rglob("*") if file.is_file())
    # One file of each kind, where every frame has one.
    kinds = {(file.parent.name, file.suffix): file for file in files}
    kinds |= {
        file.name: file for file in files if len(files) < 12 or file.suffix in (".json", ".txt")
    }
    for file in set(kinds.values()):
        whole = file.read_bytes()
        for broken in _broken(whole, rng):
            file.write_bytes(broken)
            _used(written.path)
        file.unlink()
        _used(written.path)
        file.mkdir()
        _used(written.path)
        file.rmdir()
        os.symlink(file, file)
        _used(written.path)
        file.unlink()
        file.write_bytes(whole)
    assert _used(written.path) is not None


@pytest.mark.parametrize("layout", ALL)
def test_links_in_a_circle_are_no_obstacle(layout: str, scene: Scene, tmp_path: Path) -> None:
    written = ALL[layout](tmp_path / "capture", scene)
    for folder in [tmp_path / "capture", *(tmp_path / "capture").iterdir()]:
        if folder.is_dir():
            (folder / "again").symlink_to(tmp_path / "capture", target_is_directory=True)
    capture = _used(written.path)
    assert capture is not None and len(capture.frames) == NUM


def test_tum_reads_nothing_outside_of_its_folder(scene: Scene, tmp_path: Path) -> None:
    folder = tum(tmp_path / "walk", scene).path
    outside = tmp_path / "outside.png"
    outside.write_bytes(next((folder / "rgb").iterdir()).read_bytes())
    with (folder / "rgb.txt").open("a") as file:
        file.write(f"100.1 ../outside.png\n100.15 {outside}\n100.16 rgb/../../outside.png\n")
    assert len(open_capture(folder).frames) == NUM


def test_a_million_lines_take_seconds(scene: Scene, tmp_path: Path) -> None:
    folder = tum(tmp_path / "walk", scene).path
    with (folder / "rgb.txt").open("a") as file:
        file.writelines(f"{200 + i / 100:.2f} rgb/none{i}.png\n" for i in range(10**6))
    with (folder / "groundtruth.txt").open("a") as file:
        file.writelines(f"{200 + i / 100:.2f} 0 0 0 0 0 0 1\n" for i in range(10**5))
    start = time.process_time()
    assert len(open_capture(folder).frames) == NUM
    assert time.process_time() - start < 30


@pytest.mark.parametrize("unknown", [0, -np.inf, np.inf, np.nan])
def test_a_sens_that_knows_no_place_of_its_cameras_raises_no_doubt(
    unknown: float, scene: Scene, tmp_path: Path
) -> None:
    file = ALL[".sens"](tmp_path / "capture", scene).path
    data, known = file.read_bytes(), np.eye(4, dtype="<f4").tobytes()
    file.write_bytes(data.replace(known, np.full((4, 4), unknown, "<f4").tobytes(), 2))
    assert not open_capture(file).doubts


def _sens_bomb(written: Written) -> None:
    """128 MiB of zeros in the place of the last frame's depth."""
    data = written.path.read_bytes()
    packer = zlib.compressobj(9)
    bomb = b"".join(packer.compress(bytes(2**20)) for _ in range(128)) + packer.flush()
    at = data.rindex(struct.pack("<QQ", 1, 2)) + 16
    colour, _ = struct.unpack_from("<QQ", data, at)
    head, image = data[:at], data[at + 16 : at + 16 + colour]
    written.path.write_bytes(head + struct.pack("<QQ", colour, len(bomb)) + image + bomb)


def _giant(name: str, *changes: tuple[bytes, bytes]) -> None:
    def change(written: Written) -> None:
        file = written.path / name
        data = file.read_bytes()
        for old, new in changes:
            assert old in data
            data = data.replace(old, new)
        file.write_bytes(data)

    return change


GIANTS = {
    "a deflation bomb": (".sens", _sens_bomb),
    "frames without end": (
        ".sens",
        lambda written: written.path.write_bytes(
            written.path.read_bytes().replace(
                struct.pack("<fQ", 1000, NUM), struct.pack("<fQ", 1000, 2**60), 1
            )
        ),
    ),
    "an EXR of 2^31 pixels a side": (
        "Record3D EXR",
        _giant(
            "EXR_RGBD/depth/0.exr",
            (struct.pack("<4i", 0, 0, 63, 47), struct.pack("<4i", 0, 0, 2**31 - 2, 2**31 - 2)),
        ),
    ),
    "an NPY of 10^12 numbers": ("DeMoN", _giant("0000.npy", (b"(48, 64)", b"(10**6, 10**6)"))),
    "a PFM of 10^10 pixels": ("MVSNet", _giant("depths/00000000.pfm", (b"64 48", b"99999 99999"))),
    "pairs without end": ("MVSNet", _giant("pair.txt", (b"2 2 9.5", b"2000000000 2 9.5"))),
}


@pytest.mark.parametrize("fault", GIANTS)
def test_what_claims_to_be_giant_takes_no_memory(fault: str, scene: Scene, tmp_path: Path) -> None:
    layout, change = GIANTS[fault]
    written = ALL[layout](tmp_path / "capture", scene)
    change(written)
    tracemalloc.start()
    _used(written.path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 32 * 2**20
