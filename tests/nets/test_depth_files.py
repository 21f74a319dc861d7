"""Files of depth as other programs write them, and depth of another camera."""

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image
from written_captures import exr, make_scene, sevenscenes

from deltas_nets.captures.depth_files import holds_floats
from deltas_nets.captures.exr import read_exr
from deltas_nets.captures.float_files import read_npy, read_pfm
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.register import register_depth
from deltas_nets.errors import UserError
from deltas_nets.outputs.depth_formats import read_depth_png

FILE = Path("depth")
MAPS = arrays.arrays(np.float16, arrays.array_shapes(min_dims=2, max_dims=2, max_side=40))


@given(depth=MAPS, compression=st.integers(0, 3), top=st.integers(-5, 5))
def test_exr_gives_back_every_bit(depth: np.ndarray, compression: int, top: int) -> None:
    read = read_exr(exr(depth, compression, top), FILE)
    assert np.array_equal(read, depth.astype(np.float32), equal_nan=True)


@given(depth=MAPS, order=st.sampled_from("<>"), by_column=st.booleans())
def test_pfm_and_npy_give_back_every_bit(depth: np.ndarray, order: str, by_column: bool) -> None:
    single = depth.astype(f"{order}f4")
    head = f"Pf\n{depth.shape[1]} {depth.shape[0]}\n{'-' if order == '<' else ''}1.0\n"
    pfm = head.encode() + single[::-1].tobytes()
    npy = io.BytesIO()
    np.save(npy, np.asfortranarray(single) if by_column else single)
    for read in (read_pfm(pfm, FILE), read_npy(npy.getvalue(), FILE)):
        assert np.array_equal(read, single, equal_nan=True)


@pytest.mark.parametrize("compression", range(4))
def test_a_cut_exr_is_an_error_wherever_it_is_cut(compression: int) -> None:
    whole = exr(np.linspace(0, 5, 20 * 7).reshape(20, 7), compression)
    for length in range(len(whole)):
        with pytest.raises(UserError):
            read_exr(whole[:length], FILE)


def test_compressions_that_are_not_read_are_named() -> None:
    with pytest.raises(UserError) as error:
        read_exr(exr(np.ones((2, 2)), 4), FILE)
    assert "PIZ" in error.value.what


def test_pickles_are_refused() -> None:
    file = io.BytesIO()
    np.save(file, np.array([{}], dtype=object))
    with pytest.raises(UserError) as error:
        read_npy(file.getvalue(), FILE)
    assert "object" in error.value.what


def test_depth_of_another_camera_is_seen_where_its_points_are(tmp_path: Path) -> None:
    """A slanted plane, seen by both: what the colour camera sees of it follows from geometry."""
    size, depth_size = (60, 80), (70, 90)
    K = np.array([[70.0, 0, 40], [0, 70, 30], [0, 0, 1]])
    depth_K = np.array([[100.0, 0, 44], [0, 100, 36], [0, 0, 1]])
    cam_from_depth = np.eye(4)
    cam_from_depth[:3, 3] = -0.05, 0.01, 0.02
    normal, offset = np.array([0.2, -0.1, 1]), 2.0

    def plane(K: np.ndarray, shape: tuple[int, int], shift: np.ndarray) -> np.ndarray:
        y, x = np.mgrid[: shape[0], : shape[1]]
        rays = np.linalg.inv(K) @ np.stack((x.ravel(), y.ravel(), np.ones(x.size)))
        return ((offset + normal @ shift) / (normal @ rays)).reshape(shape)

    seen = plane(depth_K, depth_size, np.zeros(3))
    Image.fromarray(np.round(seen * 1000).astype(np.uint16)).save(tmp_path / "depth.png")
    frame = Frame(
        "0", tmp_path / "0.png", size, K, np.eye(4), tmp_path / "depth.png", depth_K, depth_size,
        cam_from_depth,
    )  # fmt: skip
    registered = register_depth(frame)
    known = registered > 0
    expected = plane(K, size, cam_from_depth[:3, 3])
    # Nearest neighbours: half a pixel of slant, and 1 mm of rounding.
    assert np.abs(registered - expected)[known].max() < 0.012
    inside = (slice(8, -8), slice(10, -10))
    assert known[inside].mean() == 1


def test_depth_behind_the_other_camera_is_not_seen_by_it(tmp_path: Path) -> None:
    depth = np.array([[500, 500], [2000, 2000]], dtype=np.uint16)  # mm
    ahead = np.eye(4)
    ahead[2, 3] = -1.0  # m, that the colour camera stands before the other
    K = np.array([[2.0, 0, 0.5], [0, 2, 0.5], [0, 0, 1]])
    file = save(tmp_path / "depth.png", depth)
    frame = Frame("0", file, (2, 2), K, np.eye(4), file, K, (2, 2), ahead)
    assert set(register_depth(frame).ravel().tolist()) == {0, 1}


def test_what_is_registered_stays_where_it_is(tmp_path: Path) -> None:
    written = sevenscenes(tmp_path / "a", make_scene())
    frame = open_capture(written.path).frames.at(0)
    assert np.array_equal(register_depth(frame), frame.read_depth())


@pytest.mark.shared
def test_edges_of_registered_depth_are_edges_of_the_image(shared_data: Path) -> None:
    capture = open_capture(shared_data / "sevenscenes")
    assert any("not registered" in doubt for doubt in capture.doubts)

    def agreement(depth: np.ndarray, image: np.ndarray) -> float:
        grey = image.mean(axis=2)
        slope = np.minimum(np.hypot(*np.gradient(grey)), 50)
        inverse = np.where(depth > 0, 1 / depth.clip(0.1), np.nan)
        edges = np.abs(inverse[:, 2:] - inverse[:, :-2]) > 0.12
        return float(slope[:, 1:-1][edges].mean() / slope.mean())

    frames = [capture.frames.at(place) for place in range(0, 24, 6)]
    images = [frame.read_image() for frame in frames]
    pairs = list(zip(frames, images, strict=True))
    registered = np.mean([agreement(register_depth(frame), image) for frame, image in pairs])
    unregistered = np.mean([agreement(frame.read_depth(), image) for frame, image in pairs])
    assert registered > 1.3 * unregistered


WHOLE = np.array([[0, 1500], [2000, 65535]], dtype=np.uint16)
KNOWN = np.array([[0, 1.5], [2, 0]], dtype=np.float32)


def depth_of(file: Path, **more: float) -> np.ndarray:
    return Frame("0", file, (2, 2), np.eye(3), np.eye(4), depth_path=file, **more).read_depth()


def save(file: Path, depth: np.ndarray) -> Path:
    if file.suffix == ".npy":
        np.save(file, depth)
    elif file.suffix == ".npz":
        np.savez(file, depth=depth, unit=np.array("m"))
    else:
        Image.fromarray(depth).save(file)
    return file


@pytest.mark.parametrize("suffix", ["png", "tiff", "npy", "npz"])
def test_whole_numbers_are_steps_in_whatever_file(tmp_path: Path, suffix: str) -> None:
    file = save(tmp_path / f"depth.{suffix}", WHOLE)
    assert not holds_floats(file)
    assert depth_of(file).tolist() == KNOWN.tolist()
    assert depth_of(file, depth_scale=500.0, depth_unit=9.0).tolist() == (2 * KNOWN).tolist()


@pytest.mark.parametrize("shape", [(1, 3, 2), (3, 2, 1)])
def test_a_third_dimension_of_one_is_left_out(tmp_path: Path, shape: tuple[int, ...]) -> None:
    depth = np.arange(6, dtype=np.float32)
    file = save(tmp_path / "depth.npy", depth.reshape(shape))
    assert depth_of(file).tolist() == depth.reshape(3, 2).tolist()


@pytest.mark.parametrize("suffix", ["tiff", "npy", "npz"])
def test_floats_are_in_the_unit_in_whatever_file(tmp_path: Path, suffix: str) -> None:
    depth = np.array([[np.nan, 1.5], [2, -1]], dtype=np.float32)
    file = save(tmp_path / f"depth.{suffix}", depth)
    assert holds_floats(file)
    assert depth_of(file).tolist() == KNOWN.tolist()
    assert depth_of(file, depth_scale=500.0, depth_unit=2.0).tolist() == (2 * KNOWN).tolist()


def test_micrometres_in_32_bits_do_not_end_at_65535(tmp_path: Path) -> None:
    file = save(tmp_path / "depth.npy", np.array([[1_500_000, 70_000]], dtype=np.int32))
    assert depth_of(file, depth_scale=1e6).tolist() == [[1.5, np.float32(0.07)]]


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, which commands do not show
@pytest.mark.parametrize("suffix", ["tiff", "npy", "npz"])
def test_a_cut_file_is_an_error_wherever_it_is_cut(tmp_path: Path, suffix: str) -> None:
    file = save(tmp_path / f"depth.{suffix}", KNOWN)
    whole = file.read_bytes()
    for length in range(0, len(whole), 7):
        file.write_bytes(whole[:length])
        with pytest.raises(UserError):
            depth_of(file)
        holds_floats(file)


def test_an_npz_of_several_arrays_has_one_called_depth(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", a=KNOWN, b=KNOWN)
    with pytest.raises(UserError, match="no array called depth"):
        depth_of(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", a=KNOWN)
    assert depth_of(tmp_path / "b.npz").tolist() == KNOWN.tolist()
    np.save(tmp_path / "c.npy", KNOWN > 0)
    with pytest.raises(UserError, match="yes and no"):
        depth_of(tmp_path / "c.npy")


@pytest.mark.parametrize("scale", [1000.0, 5000.0, 256.0, 1234.567, 0.1])
def test_every_step_is_read_to_the_last_bit(tmp_path: Path, scale: float) -> None:
    steps = np.arange(2**16, dtype=np.uint16).reshape(256, 256)
    Image.fromarray(steps).save(tmp_path / "map.png")
    wanted = (steps / np.float64(scale)).astype(np.float32)
    assert (read_depth_png(tmp_path / "map.png", scale) == wanted).all()
