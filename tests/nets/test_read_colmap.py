"""COLMAP's models: as pycolmap reads and writes them, at every place, and broken."""

import shutil
import struct
import time
from pathlib import Path
from typing import Any, Literal
from unicodedata import normalize

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from posed_captures import captures, image_of

from deltas_geom.cameras.lenses.lens import Lens as Projector
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.colmap_model import CAMERA_MODELS, ColmapCamera, ColmapModel, k_and_lens
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.readers.colmap_folder import read_model
from deltas_nets.captures.readers.colmap_text import read_text_model
from deltas_nets.captures.rotations import quaternions_of, rotations_of
from deltas_nets.captures.saving import save_capture
from deltas_nets.errors import UserError

pycolmap = pytest.importorskip("pycolmap")

SHARED_MODELS = (
    "eth3d/office",
    "eth3d/relief_2",
    "formats/colmap_text/colmap_ground_truth",
    "formats/colmap_text_kapture/colmap/reconstruction",
    "formats/sceaux_models/colmap_example_model_bin",
    "formats/sceaux_models/colmap_example_model_txt",
)


def assert_as_pycolmap(model: ColmapModel, theirs: Any) -> None:
    """Cameras, poses, points and every observation are those that pycolmap reads."""
    assert {id: tuple(camera.params) for id, camera in theirs.cameras.items()} == {
        id: camera.params for id, camera in model.cameras.items()
    }
    assert sorted(model.images.ids.tolist()) == sorted(theirs.images)
    rotations = rotations_of(model.images.quaternions)
    for place, id in enumerate(model.images.ids.tolist()):
        image = theirs.images[id]
        assert (image.name, image.camera_id) == (
            model.images.names[place],
            model.images.camera_ids[place],
        )
        pose = image.cam_from_world()
        # Not its matrix: what was printed with six digits stays as it is there.
        rotation = rotations_of(pose.rotation.quat[[3, 0, 1, 2]])
        np.testing.assert_allclose(rotation, rotations[place], atol=1e-12)
        np.testing.assert_allclose(pose.translation, model.images.translations[place], atol=1e-12)
        seen = [point for point in image.points2D if point.has_point3D()]
        mine = model.tracks.image == place
        xy = np.array([point.xy for point in seen]).reshape(-1, 2)
        np.testing.assert_allclose(xy, model.tracks.pixels[mine])
        ids = [point.point3D_id for point in seen]
        np.testing.assert_array_equal(ids, model.tracks.point_ids[mine])
    for place, id in enumerate(model.points.ids.tolist()):
        point = theirs.points3D[id]
        np.testing.assert_allclose(point.xyz, model.points.xyz[place])
        np.testing.assert_array_equal(point.color, model.points.rgb[place])
    assert len(model.points.ids) == len(theirs.points3D)


@pytest.mark.shared
@pytest.mark.parametrize("name", SHARED_MODELS)
def test_models_are_read_as_pycolmap_reads_them(shared_data: Path, name: str) -> None:
    assert_as_pycolmap(read_model(shared_data / name), pycolmap.Reconstruction(shared_data / name))


@pytest.fixture(scope="module")
def synthetic() -> Any:
    """A model with rigs of two cameras, of this pycolmap's version."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 3
    options.num_points3D = 40
    return pycolmap.synthesize_dataset(options)


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_rigs_and_frames_of_new_versions_do_not_matter(
    synthetic: Any, tmp_path: Path, kind: str
) -> None:
    getattr(synthetic, f"write_{kind}")(tmp_path)
    assert any(tmp_path.glob("rigs.*"))
    assert_as_pycolmap(read_model(tmp_path), pycolmap.Reconstruction(tmp_path))


@pytest.mark.parametrize("to", ["colmap", "colmap-bin"])
@settings(max_examples=15)
@given(capture=captures())
def test_pycolmap_reads_what_we_write(
    tmp_path_factory: pytest.TempPathFactory, to: str, capture: Capture
) -> None:
    folder = tmp_path_factory.mktemp("written") / "out"
    said = save_capture(capture, folder, to)
    cut = to == "colmap" and any(" " in id for id in capture.frames)
    assert cut == any("colmap-bin" in what for what in said)
    if cut:  # by what reads a name up to a space
        return
    theirs = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert_as_pycolmap(read_model(folder / "sparse" / "0"), theirs)
    points = 0 if capture.points is None else len(capture.points.xyz)
    seen = 0 if capture.points is None else len(capture.points.seen.point)
    assert (theirs.num_points3D(), theirs.compute_num_observations()) == (points, seen)
    for id, frame in zip(sorted(theirs.images), capture.frames.values(), strict=True):
        pose = theirs.images[id].cam_from_world().matrix()
        np.testing.assert_allclose(pose, frame.cam_from_world[:3], atol=1e-9)


@pytest.mark.parametrize("name", [name for name in CAMERA_MODELS if name != "EUCM"])
def test_cameras_project_as_pycolmaps_half_a_pixel_aside(name: str) -> None:
    if not hasattr(pycolmap.CameraModelId, name):
        pytest.skip("this pycolmap is older")
    camera = pycolmap.Camera(model=name, width=640, height=480)
    bends = [0.05, -0.02, 0.01, 0.003, 0.02, 0.01, 0.004, -0.01, 0.01, 0.003, 0.002, 0.001]
    focal = [500.0, 510.0][: CAMERA_MODELS[name].num_focal]
    numbers = [*focal, 321.0, 239.0, *bends[: CAMERA_MODELS[name].num_coefficients]]
    camera.params = numbers if focal else [640, 480]
    K, lens = k_and_lens(ColmapCamera(name, (480, 640), tuple(camera.params)))
    points = np.random.default_rng(0).uniform((-0.4, -0.4, 1.1), (0.4, 0.4, 1.9), (50, 3))
    theirs = camera.img_from_cam(points)
    coefficients = torch.tensor([] if lens is None else lens.coefficients, dtype=torch.float64)
    model = "PINHOLE" if lens is None else lens.model
    ours = Projector(torch.tensor(K), coefficients, model).project(torch.tensor(points))
    np.testing.assert_allclose(ours.pixels.numpy(), theirs - 0.5, atol=1e-9)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: max(map(abs, q)) > 0.1))
def test_quaternions_and_rotations_are_each_others_inverse(numbers: list[float]) -> None:
    rotation = rotations_of(1e200 * np.array(numbers))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotations_of(quaternions_of(rotation)), rotation, atol=1e-14)


CAMERAS = "1 SIMPLE_RADIAL 8 6 9 4 3 -0.1\n2 PINHOLE 8 6 9 10 4 3\n"
IMAGES = (
    "# a comment\n1 1 0 0 0 0 0 0 1 a.png\n\n"
    "2 2 0 0 0 1 0 0 2 sub folder/b c.png\n1.5 2.5 7 3 4 -1\n# another\n"
    "3 0.5 0.5 0.5 0.5 0 0 1 1 gone.png\n1.5 2.5 7\n"
)
POINTS = "# x\n7 1 2 3 4 5 6 0.25 2 0 3 0\n9 1 2 3 4 5 6 -1\n"


def write_model(
    capture: Path, place: str = "sparse/0", photos: str = "images", images: str = IMAGES
) -> Path:
    model = capture / place
    model.mkdir(parents=True, exist_ok=True)
    (model / "cameras.txt").write_text(CAMERAS)
    (model / "images.txt").write_text(images)
    (model / "points3D.txt").write_text(POINTS)
    for name in ("a.png", "sub folder/b c.png"):
        (capture / photos / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(image_of((6, 8)), capture / photos / name)
    return capture


@pytest.mark.parametrize("photos", ["images", "photos/deep", "", "input"])
@pytest.mark.parametrize(
    "place", ["sparse/0", "sparse", "", "colmap/sparse/0", "any name", "dense/0/any"]
)
def test_models_and_images_are_found_wherever_they_are(
    tmp_path: Path, place: str, photos: str
) -> None:
    capture = open_capture(write_model(tmp_path / "it", place, photos))
    assert list(capture.frames) == ["a", "sub folder/b c"]
    assert {id: lost.reason for id, lost in capture.lost.items()} == {"gone": "no image"}
    assert (capture.layout, capture.metric) == ("COLMAP text", False)
    first, second = capture.frames.values()
    assert first.K.tolist() == [[9, 0, 3.5], [0, 9, 2.5], [0, 0, 1]]
    assert first.lens is not None and second.lens is None
    assert second.cam_from_world[:3].tolist() == [[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]]
    assert capture.points is not None
    assert np.isnan(capture.points.error).tolist() == [False, True]
    seen = capture.points.seen
    assert (seen.point.tolist(), seen.frame.tolist()) == ([0], [1])
    assert seen.pixels.tolist() == [[1, 2]]


@pytest.mark.parametrize("stem", ["cameras", "images"])
def test_a_model_of_both_kinds_is_refused_by_the_file_it_lacks(tmp_path: Path, stem: str) -> None:
    model = write_model(tmp_path) / "sparse" / "0"
    (model / f"{stem}.txt").rename(model / f"{stem}.bin")
    (model / "points3D.txt").unlink()
    with pytest.raises(UserError) as error:
        open_capture(tmp_path)
    assert f"it has {stem}.bin, no {stem}.txt" in error.value.what and error.value.where == model


@pytest.mark.parametrize("forms", [("NFC", "NFD"), ("NFD", "NFC")])
def test_accents_may_be_written_in_one_letter_or_two(
    tmp_path: Path, forms: tuple[Literal["NFC", "NFD"], Literal["NFC", "NFD"]]
) -> None:
    in_model, on_disk = (normalize(form, "K\u00fcche/\u00c0.png") for form in forms)
    write_model(tmp_path, images=f"1 1 0 0 0 0 0 0 1 {in_model}\n\n")
    file = tmp_path / "images" / on_disk
    file.parent.mkdir()
    shutil.copy(image_of((6, 8)), file)
    capture = open_capture(tmp_path)
    assert not capture.lost and not capture.doubts
    assert [frame.image_path for frame in capture.frames.values()] == [file]


@pytest.mark.parametrize("part", ["sparse/0", "sparse", "sparse/0/images.txt"])
def test_the_model_itself_may_be_named(
    tmp_path: Path, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = "sparse" if part == "sparse" else "sparse/0"
    folder = write_model(tmp_path / "it", place)
    assert len(open_capture(folder / part).frames) == 2
    monkeypatch.chdir(folder / place)
    assert len(open_capture(".").frames) == 2


def test_the_largest_of_several_models_is_read_and_the_others_are_said(tmp_path: Path) -> None:
    write_model(tmp_path, "sparse/0", images="1 1 0 0 0 0 0 0 1 a.png\n\n")
    capture = open_capture(write_model(tmp_path, "sparse/1"))
    assert len(capture.frames) == 2
    assert "sparse/1" in capture.doubts[0] and "0 (1)" in capture.doubts[0]


def test_of_equal_models_the_one_whose_images_are_there_is_read(tmp_path: Path) -> None:
    other = IMAGES.replace("a.png", "raw/gone.png").replace("b c", "gone too")
    write_model(tmp_path, "calibration_raw", images=other)
    assert len(open_capture(write_model(tmp_path, "calibration_undistorted")).frames) == 2


def test_captures_side_by_side_must_be_told_apart(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_model(tmp_path / name)
    with pytest.raises(UserError, match="2 captures"):
        open_capture(tmp_path)


def test_resized_images_have_scaled_intrinsics_and_pixels(tmp_path: Path) -> None:
    folder = write_model(tmp_path)
    for file in (folder / "images").rglob("*.png"):
        Image.open(file).resize((4, 3)).save(file)
    capture = open_capture(folder)
    assert len(capture.doubts) == 1 and "scaled" in capture.doubts[0]
    assert capture.frame("a").image_size == (3, 4)
    assert capture.frame("a").K[0].tolist() == [4.5, 0, 1.5]
    assert capture.points is not None
    assert capture.points.seen.pixels.tolist() == [[0.25, 0.75]]


@pytest.mark.parametrize("size", [(6, 8), (8, 8)])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_images_of_another_shape_are_refused(
    tmp_path: Path, size: tuple[int, int], orientation: int
) -> None:
    folder = write_model(tmp_path)
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.new("RGB", size).save(folder / "images" / "a.png", exif=exif)
    with pytest.raises(UserError) as error:
        open_capture(folder)
    assert error.value.where == folder / "images" / "a.png"
    # It is blamed where it turns the file on its side, and nowhere else.
    assert ("EXIF" in error.value.remedy) == (size == (6, 8) and orientation > 4)
    assert ("rotate the images back" in error.value.remedy) == (size == (6, 8) and orientation < 5)


def test_lines_of_images_without_pixels_may_be_left_out(tmp_path: Path) -> None:
    images = "1 1 0 0 0 0 0 0 1 a.png\n2 1 0 0 0 0 0 0 1 sub folder/b c.png"
    assert len(open_capture(write_model(tmp_path, images=images)).frames) == 2


def test_a_lost_pose_is_no_pose(tmp_path: Path) -> None:
    images = IMAGES.replace("1 1 0 0 0", "1 nan 0 0 0").replace("2 2 0 0 0", "2 0 0 0 0")
    folder = write_model(tmp_path, images=images)
    shutil.copy(image_of((6, 8)), folder / "images" / "gone.png")
    capture = open_capture(folder)
    assert list(capture.frames) == ["gone"]
    assert {lost.reason for lost in capture.lost.values()} == {"no pose"}


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("cameras.txt", "1 SIMPLE_RADIAL 8 6 9 4 3\n"),
        ("cameras.txt", "1 CUBIC 8 6 9 4 3\n"),
        ("cameras.txt", "x PINHOLE 8 6 9 9 4 3\n"),
        ("cameras.txt", "1 PINHOLE\n"),
        ("cameras.txt", "1 PINHOLE 8 6 0 9 4 3\n"),
        ("cameras.txt", "1 PINHOLE 8 6 nan 9 4 3\n"),
        ("cameras.txt", "1 PINHOLE 0 6 9 9 4 3\n"),
        ("cameras.txt", CAMERAS + CAMERAS),
        ("cameras.txt", ""),
        ("cameras.txt", b"\xff\xfe"),
        ("images.txt", "1 1 0 0 0 0 0 0 1\n\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n1 2\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n1 2 x\n"),
        ("images.txt", "1.5 1 0 0 0 0 0 0 1 a.png\n\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 1e30 a.png\n\n"),
        ("images.txt", IMAGES + "4 1 0 0 0 0 0 0 1 a.png\n\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 ../../\n\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a\0.png\n\n"),
        ("images.txt", ""),
        ("images.txt", b"\xff\xfe"),
        ("points3D.txt", "7 1 2 3\n"),
        ("points3D.txt", "7 1 2 3 4 5 x 0\n"),
        ("points3D.txt", b"\xff\xfe"),
    ],
)
def test_broken_text_is_one_line_of_error(tmp_path: Path, file: str, content: str | bytes) -> None:
    path = write_model(tmp_path) / "sparse" / "0" / file
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UserError) as error:
        open_capture(tmp_path)
    assert Path(error.value.where).name == file


@pytest.mark.parametrize("count", [2**63, 2**64 - 1, 10**9])
@pytest.mark.parametrize(
    ("file", "place"),
    [("cameras.bin", 0), ("images.bin", 0), ("points3D.bin", 0), ("points3D.bin", 51)],
)
def test_counts_that_no_file_can_hold_are_refused_before_memory_is_asked_for(
    synthetic: Any, tmp_path: Path, file: str, place: int, count: int
) -> None:
    synthetic.write_binary(tmp_path)
    data = bytearray((tmp_path / file).read_bytes())
    data[place : place + 8] = struct.pack("<Q", count)
    (tmp_path / file).write_bytes(data)
    with pytest.raises(UserError) as error:
        read_model(tmp_path)
    assert error.value.where == tmp_path / file


@pytest.mark.parametrize("name", ["../../../secret.png", "{outside}/secret.png"])
def test_names_never_lead_far_from_the_capture(tmp_path: Path, name: str) -> None:
    shutil.copy(image_of((6, 8)), tmp_path / "secret.png")
    images = f"{IMAGES}4 1 0 0 0 0 0 0 1 {name.format(outside=tmp_path)}\n\n"
    folder = write_model(tmp_path / "a" / "b" / "it", images=images)
    (folder / "images" / "cycle").symlink_to(folder)
    (folder / "all").symlink_to("/")
    capture = open_capture(folder)
    assert len(capture.frames) == 2
    assert [lost.reason for lost in capture.lost.values()] == ["no image"] * 2


def test_a_million_lines_take_seconds(tmp_path: Path) -> None:
    folder = write_model(tmp_path)
    line = "1.25 2.5 3.75 10 20 30 0.5 1 2 3 4 5 6 7 8\n"
    with (folder / "sparse/0/points3D.txt").open("w") as file:
        file.writelines(f"{id} {line}" for id in range(1, 10**6 + 1))
    start = time.process_time()
    model = read_text_model(folder / "sparse" / "0")
    assert len(model.points.ids) == 10**6
    assert time.process_time() - start < 15


@pytest.mark.shared
def test_text_and_binary_of_one_reconstruction_agree(shared_data: Path) -> None:
    folder = shared_data / "formats" / "sceaux_models"
    text = read_model(folder / "colmap_example_model_txt")
    binary = read_model(folder / "colmap_example_model_bin")
    order, same = np.argsort(text.images.ids), np.argsort(binary.images.ids)
    for mine, theirs in zip(text.images[2:4], binary.images[2:4], strict=True):
        np.testing.assert_allclose(mine[order], theirs[same], rtol=2e-5, atol=2e-5)
    # Printed with six digits: errors agree to a hundredth of a pixel.
    first, second = reprojection_errors(text), reprojection_errors(binary)
    assert np.median(first) == pytest.approx(np.median(second), abs=0.01)
    assert first.mean() == pytest.approx(second.mean(), abs=0.01)


def reprojection_errors(model: ColmapModel) -> FloatArray:
    """Distances of tracks from their points, of a model with one camera."""
    K, lens = k_and_lens(next(iter(model.cameras.values())))
    assert lens is not None
    order = np.argsort(model.points.ids)
    place = order[np.searchsorted(model.points.ids[order], model.tracks.point_ids)]
    rotations = rotations_of(model.images.quaternions)[model.tracks.image]
    points = np.einsum("tij,tj->ti", rotations, model.points.xyz[place])
    points += model.images.translations[model.tracks.image]
    camera = Projector(
        torch.tensor(K), torch.tensor(lens.coefficients, dtype=torch.float64), lens.model
    )
    pixels = camera.project(torch.tensor(points)).pixels.numpy()
    return np.asarray(np.linalg.norm(pixels - (model.tracks.pixels - 0.5), axis=-1))


@pytest.mark.shared
@pytest.mark.parametrize(("name", "count"), [("colmap_text", 12), ("colmap_text_kapture", 4)])
def test_samples_open_as_they_are(shared_data: Path, name: str, count: int) -> None:
    capture = open_capture(shared_data / "formats" / name)
    assert len(capture.frames) == count and not capture.lost and not capture.doubts
    assert capture.points is not None and capture.points.seen.frame.max() == count - 1


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "model", "pair"),
    [
        ("colmap_text", "colmap_ground_truth", ("DSC_0003", "DSC_0004")),
        ("colmap_text_kapture", "colmap/reconstruction", ("00", "01")),
    ],
)
def test_matches_lie_on_epipolar_lines_as_closely_as_with_pycolmap(
    shared_data: Path, name: str, model: str, pair: tuple[str, str]
) -> None:
    folder = shared_data / "formats" / name
    frames = [open_capture(folder).frames[id] for id in pair]
    pixels = sift_matches(*(frame.image_path for frame in frames))
    theirs = pycolmap.Reconstruction(folder / model)
    images = [
        next(image for image in theirs.images.values() if Path(image.name).stem == id)
        for id in pair
    ]
    cameras = [theirs.cameras[image.camera_id] for image in images]
    oracle = epipolar_residual(
        [camera.cam_from_img(p + 0.5) for camera, p in zip(cameras, pixels, strict=True)],
        [image.cam_from_world().matrix() for image in images],
    )
    ours = epipolar_residual(
        [rays_of(frame, p) for frame, p in zip(frames, pixels, strict=True)],
        [frame.cam_from_world[:3] for frame in frames],
    )
    assert ours < 1.2 * oracle


def sift_matches(first: Path, second: Path) -> tuple[FloatArray, FloatArray]:
    """Pixels of good matches, found at half resolution; centres at integers of the whole image."""
    cv2 = pytest.importorskip("cv2")
    found = []
    for path in (first, second):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        found.append(cv2.SIFT_create(2000).detectAndCompute(half, None))
    pairs = cv2.BFMatcher().knnMatch(found[0][1], found[1][1], k=2)
    matches = [best for best, other in pairs if best.distance < 0.75 * other.distance]
    points = [
        np.array([keypoints[getattr(match, index)].pt for match in matches])
        for (keypoints, _), index in zip(found, ("queryIdx", "trainIdx"), strict=True)
    ]
    return 2 * (points[0] + 0.5) - 0.5, 2 * (points[1] + 0.5) - 0.5


def rays_of(frame: Frame, pixels: FloatArray) -> FloatArray:
    """Normalised image coordinates without distortion."""
    lens = frame.lens
    coefficients = torch.tensor(() if lens is None else lens.coefficients, dtype=torch.float64)
    camera = Projector(
        torch.tensor(frame.K), coefficients, "PINHOLE" if lens is None else lens.model
    )
    rays = camera.unproject(torch.tensor(pixels)).rays.numpy()
    return np.asarray(rays[:, :2] / rays[:, 2:])


def epipolar_residual(rays: list[FloatArray], poses: list[FloatArray]) -> float:
    """Median Sampson distance of the better half of matches: false ones are in the other."""
    first, second = (np.concatenate([each, np.ones((len(each), 1))], axis=1) for each in rays)
    rotation = poses[1][:, :3] @ poses[0][:, :3].T
    x, y, z = poses[1][:, 3] - rotation @ poses[0][:, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    lines, back = first @ essential.T, second @ essential
    squared = (lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    distance = np.abs((second * lines).sum(axis=1)) / np.sqrt(squared)
    return float(np.median(np.sort(distance)[: len(distance) // 2]))
