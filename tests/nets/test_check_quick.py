"""What files and cameras tell of a capture before any image is looked at."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from check_plants import CAMERAS, frames, poses, scaled
from PIL import Image, ImageFilter

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame, Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.check.depth_files import unreadable_depth
from deltas_nets.check.finding import Fault
from deltas_nets.check.image_sizes import wrong_sizes
from deltas_nets.check.images import look_at_images
from deltas_nets.check.quick import quick_findings
from deltas_nets.check.rewrite import moved_centre

MakeCapture = Callable[..., Path]


@pytest.fixture
def whole(make_capture: MakeCapture) -> Capture:
    """Nine frames, each with an image of its own."""
    folder = make_capture(9, image_size=(96, 128), depth_size=(96, 128))
    random = np.random.default_rng(0)
    for id in range(9):
        pixels = random.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        image = Image.fromarray(pixels).resize((128, 96))
        image.save(folder / "color" / f"{id}.jpg", quality=95)
    return open_capture(folder)


def causes(capture: Capture) -> list[Fault]:
    return [finding.cause for finding in quick_findings(capture)]


def test_nothing_is_found_in_a_capture_that_is_well(whole: Capture) -> None:
    assert causes(whole) == [] and look_at_images(whole) == [] and wrong_sizes(whole) == []


@pytest.mark.parametrize("name", CAMERAS)
def test_a_planted_fault_is_named_and_its_mend_mends_it(name: str, whole: Capture) -> None:
    plant, cause = CAMERAS[name]
    planted = plant(whole)
    (found,) = quick_findings(planted)
    assert found.cause is cause and found.cure and found.evidence
    if found.mend is not None:
        assert causes(found.mend(planted)) == []
    else:
        # A unit that nothing measures is told, and not mended.
        assert cause in (Fault.NO_BASELINE, Fault.NOT_METRES)


@pytest.mark.parametrize("name", ["centre at 0", "centre in parts of the image"])
def test_a_centre_that_nobody_stated_leaves_the_focal_length(name: str, whole: Capture) -> None:
    planted = CAMERAS[name][0](whole)
    (found,) = quick_findings(planted)
    assert found.mend is not None and "cx 63.5 cy 47.5" in found.cure
    K = found.mend(planted).frames.K
    assert (K[:, 0, 0] == whole.frames.K[:, 0, 0]).all() and (K[:, 0, 2] == 63.5).all()


def test_a_K_in_parts_of_the_image_is_multiplied(whole: Capture) -> None:
    planted = CAMERAS["K in parts of the image"][0](whole)
    (found,) = quick_findings(planted)
    assert found.mend is not None and "multiply" in found.cure
    assert np.allclose(found.mend(planted).frames.K, whole.frames.K)


def test_what_looks_like_another_size_may_be_a_crop(whole: Capture) -> None:
    shift = np.array([[0.0, 0, -20], [0, 0, -15], [0, 0, 0]])
    planted = frames(lambda _, f: replace(f, K=f.K + shift, image_size=(81, 108)))(whole)
    (found,) = (one for one in quick_findings(planted) if one.cause is Fault.K_OF_OTHER_SIZE)
    assert found.cure.startswith("unless photos are cropped, scale it")


def test_both_units_that_poses_may_have_are_told(whole: Capture) -> None:
    (found,) = quick_findings(CAMERAS["millimetres"][0](whole))
    assert "centimetres" in found.cure and "millimetres" in found.cure


def test_lost_poses_are_named_by_frame(make_capture: MakeCapture) -> None:
    folder = make_capture(5)
    (folder / "pose" / "3.txt").write_text("nan " * 16)
    (folder / "pose" / "4.txt").write_text("-inf " * 16)
    capture = open_capture(folder)
    found = next(one for one in quick_findings(capture) if one.cause is Fault.POSES_LOST)
    assert found.frames == ("3", "4") and found.severity == "warning" and found.mend is not None
    assert Fault.POSES_LOST not in causes(found.mend(capture))


@pytest.mark.parametrize(
    "lens", [Lens("OPENCV", (0.26, -0.95, -0.005, 0.003)), Lens("SIMPLE_RADIAL", (-0.3,))]
)
def test_lenses_that_there_are_raise_no_alarm(lens: Lens, whole: Capture) -> None:
    lenses = frames(lambda _, frame: replace(frame, lens=lens))
    assert causes(lenses(whole)) == []


def test_only_metres_can_be_wrong_metres(whole: Capture) -> None:
    planted = CAMERAS["millimetres"][0](whole)
    assert causes(replace(planted, metric=False)) == []


def test_sizes_that_are_swapped_are_named_and_mended(whole: Capture) -> None:
    planted = frames(lambda _, f: replace(f, image_size=f.image_size[::-1]))(whole)
    (found,) = wrong_sizes(planted)
    assert found.cause is Fault.SIDES_SWAPPED and found.mend is not None
    mended = found.mend(planted)
    assert wrong_sizes(mended) == [] and (mended.frames.K == whole.frames.K).all()


def test_images_that_are_all_broken_are_not_left_out(whole: Capture) -> None:
    for frame in whole.frames.values():
        frame.image_path.write_bytes(b"no image")
    (found,) = look_at_images(whole)
    assert found.cause is Fault.IMAGES_UNREADABLE and found.frames == ()
    assert found.mend is None and "leave out" not in found.cure


def test_depth_that_no_command_can_read_is_named(whole: Capture) -> None:
    assert unreadable_depth(whole) == []
    for frame in whole.frames.values():
        assert frame.depth_path is not None
        Image.new("L", (128, 96), 100).save(frame.depth_path)
    (found,) = unreadable_depth(whole)
    assert found.cause is Fault.DEPTH_UNREADABLE and found.severity == "warning"
    assert "pixels of type L" in found.evidence and len(found.frames) == 9


def test_a_portrait_is_as_sharp_as_the_landscapes_around_it(whole: Capture) -> None:
    for number, frame in enumerate(whole.frames.values()):
        pixels = np.random.default_rng(number).integers(0, 255, (60, 96, 1), dtype=np.uint8)
        large = Image.fromarray(np.repeat(pixels, 3, axis=-1)).resize((1000, 240))
        if number == 4:
            large = large.transpose(Image.Transpose.ROTATE_90)
        large.save(frame.image_path, quality=95)
    assert look_at_images(whole) == []


def test_blurred_broken_and_repeated_images_are_named(whole: Capture) -> None:
    files = {id: frame.image_path for id, frame in whole.frames.items()}
    Image.open(files["2"]).filter(ImageFilter.GaussianBlur(3)).save(files["2"], quality=95)
    Image.open(files["5"]).save(files["6"], quality=98)
    files["8"].write_bytes(b"no image")
    found = {finding.cause: finding.frames for finding in look_at_images(whole)}
    assert found == {
        Fault.BLURRED: ("2",),
        Fault.DUPLICATE_FRAMES: ("6",),
        Fault.IMAGES_UNREADABLE: ("8",),
    }


@pytest.mark.shared
@pytest.mark.parametrize("name", ["colmap_text", "colmap_text_kapture", "openmvg", "opensfm"])
def test_sparse_points_tell_of_half_a_pixel_and_of_scale(name: str, shared_data: Path) -> None:
    capture = open_capture(shared_data / "formats" / name)
    assert quick_findings(capture) == []
    for plant, cause in (
        (frames(lambda _, frame: moved_centre(frame, 0.5)), Fault.HALF_A_PIXEL),
        (poses(lambda pose: scaled(pose, 3.7)), Fault.WRONG_SCALE),
    ):
        planted = plant(capture)
        (found,) = quick_findings(planted)
        assert found.cause is cause and found.mend is not None
        assert quick_findings(found.mend(planted)) == []


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [(1, 1), (2, 2), (500, 1)])
def test_images_of_few_pixels_are_closed_and_say_nothing(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    frames = []
    for number in range(3):
        file = tmp_path / f"{number}.png"
        Image.fromarray(np.full((*size, 3), 40 * number, np.uint8)).save(file)
        frames.append(Frame(str(number), file, size, np.eye(3), np.eye(4)))
    assert look_at_images(Capture(tmp_path, Frames.of(frames), {})) == []
