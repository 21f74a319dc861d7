"""The reference network's file: what loads, what is refused; and the page of differences."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from reference_tables import Tables, random_tables
from torch import Tensor
from torch.testing import assert_close

from deltas_geom.checks import ShapeError
from deltas_nets import reference
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.errors import UserError
from deltas_nets.reference import ReferenceNetwork
from deltas_nets.reference.checkpoint import ENTRIES
from deltas_nets.reference.differences import DIFFERENCES, page
from deltas_nets.weights_file import weights_file


@pytest.fixture(scope="module")
def tables() -> Tables:
    return random_tables()


@pytest.fixture(scope="module")
def file(tables: Tables, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("published") / "checkpoint.pth.tar"
    torch.save(tables | {"epoch": 3}, path)
    return path


@pytest.fixture(scope="module")
def network(file: Path) -> ReferenceNetwork:
    return reference.load(file)


def test_a_file_gives_the_network_its_weights(network: ReferenceNetwork, tables: Tables) -> None:
    assert not network.training
    image, match, depth = (tables[entry] for entry in ENTRIES)
    given = {
        "encoder.layer3.5.conv2.weight": image["layer3.5.conv2.weight"],
        "detector_head.convPb.weight": image["convPb.weight"],
        "descriptor_head.convDd.bias": image["convDd.bias"],
        "match_norm.bn_match_convD.bias": match["bn_match_convD.bias"],
        "densifier.encoder.conv1.weight": depth["conv1.weight"],
        "densifier.decoder.ASPP.convf.weight": depth["ASPP.convf.weight"],
        "densifier.decoder.ASPP.bnf.num_batches_tracked": torch.tensor(7),
    }
    weights = network.state_dict()
    for name, weight in given.items():
        assert torch.equal(weights[name], weight), name
    assert {weight.device.type for weight in weights.values()} == {"cpu"}


def test_tables_and_arrays_load_like_a_file(network: ReferenceNetwork, tables: Tables) -> None:
    without_counters: dict[str, dict[str, Any]] = {
        entry: {key: weight.numpy() for key, weight in table.items() if weight.ndim}
        for entry, table in tables.items()
    }
    loaded = reference.load(*without_counters.values()).state_dict()
    for name, weight in network.state_dict().items():
        assert torch.equal(loaded[name], weight) or name.endswith("tracked"), name


def test_given_weights_are_copied(tables: Tables) -> None:
    bias = torch.zeros(1)
    changed = tables | {"state_dict_tri": tables["state_dict_tri"] | {"bn_match_convD.bias": bias}}
    loaded = reference.load(changed)  # a mapping from the entries' names
    bias += 1
    assert loaded.match_norm.bn_match_convD.bias.item() == 0


@pytest.mark.parametrize(
    ("entry", "key", "value", "message"),
    [
        ("state_dict", "convPb.weight", None, r"state_dict has no convPb\.weight"),
        ("state_dict_tri", "bn_match_convD.running_var", None, "no bn_match_convD.running_var"),
        (
            "state_dict_depth",
            "conv_final.bias",
            torch.zeros(2),
            r"conv_final\.bias of state_dict_depth has shape \(2,\), not \(1,\)",
        ),
        ("state_dict", "fc.weight", torch.zeros(2), r"state_dict holds fc\.weight, which no layer"),
        ("state_dict", "convPb.bias", "text", r"convPb\.bias of state_dict is a str"),
        (
            "state_dict_depth",
            "conv_final.bias",
            torch.full((1,), torch.nan),
            r"conv_final\.bias of state_dict_depth is not finite",
        ),
    ],
)
def test_damaged_tables_are_named(
    tables: Tables, tmp_path: Path, entry: str, key: str, value: Any, message: str
) -> None:
    table: dict[str, Any] = dict(tables[entry]) | {key: value}
    if value is None:
        del table[key]
    damaged = tmp_path / "damaged.pth"
    torch.save(tables | {entry: table}, damaged)
    with pytest.raises(UserError, match=message) as raised:
        reference.load(damaged)
    assert raised.value.where == damaged
    with pytest.raises(UserError, match=message + r".*the given tables"):
        reference.load(tables | {entry: table})


def test_other_files_are_told_from_published_ones(
    file: Path, tables: Tables, tmp_path: Path
) -> None:
    assert reference.is_published(file)
    assert reference.is_published(str(file))
    old = tmp_path / "old.pth"
    torch.save(tables, old, _use_new_zipfile_serialization=False)  # as torch wrote before 1.6
    assert reference.is_published(old)
    two = {entry: tables[entry] for entry in ENTRIES[:2]}
    torch.save(two, tmp_path / "two.pth")
    torch.save([1], tmp_path / "list.pth")
    (tmp_path / "cut.pth").write_bytes(file.read_bytes()[:5000])
    (tmp_path / "empty.pth").write_bytes(b"")
    refused = {
        "two.pth": "no table state_dict_depth",
        "list.pth": "holds a list, not tables",
        "cut.pth": "not a torch file of plain tensors",
        "empty.pth": "not a torch file of plain tensors",
        "absent.pth": "no such file",
    }
    for name, message in refused.items():
        assert not reference.is_published(tmp_path / name), name
        with pytest.raises(UserError, match=message):
            reference.load(tmp_path / name)
    assert not reference.is_published(weights_file("deltas-small"))
    with pytest.raises(TypeError, match="3 tables"):
        reference.load(tables, tables)


class Harmful:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return (pytest.fail, ("a file ran code",))


def test_a_file_cannot_run_code(tables: Tables, tmp_path: Path) -> None:
    torch.save(tables | {"optimizer": Harmful()}, tmp_path / "harmful.pth")
    assert not reference.is_published(tmp_path / "harmful.pth")
    with pytest.raises(UserError, match="plain tensors"):
        reference.load(tmp_path / "harmful.pth")


@pytest.fixture(scope="module")
def cameras() -> tuple[Tensor, Tensor]:
    """Of two anchors with two sources each: K ``(2, 3, 3)`` and poses ``(2, 2, 4, 4)``."""
    K = torch.tensor([[60.0, 0, 31.5], [0, 60, 19.5], [0, 0, 1]]).repeat(2, 1, 1)
    poses = torch.eye(4).repeat(2, 2, 1, 1)
    poses[..., 0, 3] = torch.tensor([[-0.1, 0.1], [-0.2, 0.15]])
    return K, poses


def test_two_anchors_at_once_are_as_each_alone(
    network: ReferenceNetwork, cameras: tuple[Tensor, Tensor]
) -> None:
    """A batch holds the anchors, then their first sources, then their second ones."""
    K, poses = cameras
    images = torch.rand(6, 3, 40, 64, generator=torch.Generator().manual_seed(1))
    keypoints = 20 + 10 * torch.rand(2, 16, 2, generator=torch.Generator().manual_seed(2))
    features = network.features(images)
    matched = network.match(features.descriptor.unit, keypoints, K, poses, probe_points=[3])
    dense = network.densify(
        features.taps.of_first(2), keypoints, matched.points_3d, matched.in_range
    )
    assert matched.in_range.any()
    for which in range(2):
        mine = slice(which, which + 1)
        alone = network.run(
            images[which::2], keypoints[mine], K[mine], poses[mine], probe_points=[3]
        )
        assert_close(matched.matches[mine], alone.matches, rtol=1e-3, atol=1e-3)
        assert_close(matched.confidence[mine], alone.confidence, rtol=1e-3, atol=1e-3)
        assert_close(matched.probe_dlt[mine], alone.probe_dlt, rtol=1e-3, atol=1e-3)
        assert_close(dense.dense_depth[mine], alone.dense_depth, rtol=1e-3, atol=1e-3)


def test_a_prediction_is_repeatable_and_has_all_its_points(
    network: ReferenceNetwork, cameras: tuple[Tensor, Tensor]
) -> None:
    images = torch.rand(3, 3, 40, 64, generator=torch.Generator().manual_seed(3))
    first, second = (
        network.predict(
            images,
            cameras[0][:1],
            cameras[1][:1],
            settings=NetworkSettings(num_points=32),
            generator=torch.Generator().manual_seed(5),
        )
        for _ in range(2)
    )
    assert torch.equal(first.depth, second.depth)
    assert first.depth.shape == (1, 1, 40, 64)
    assert first.keypoints.shape == (1, 32, 2)
    assert first.matched.points_3d.shape == (1, 32, 3)


def test_wrong_shapes_are_refused(
    network: ReferenceNetwork, cameras: tuple[Tensor, Tensor]
) -> None:
    K, poses = cameras
    with pytest.raises(ShapeError, match="multiples of 8, got \\(40, 60\\)"):
        network.features(torch.rand(3, 3, 40, 60))
    descriptors = torch.rand(3, 128, 5, 8)
    with pytest.raises(ShapeError, match=r"descriptors must have shape \(6, D, h, w\)"):
        network.match(descriptors, torch.zeros(2, 4, 2), K, poses)
    with pytest.raises(ShapeError, match=r"intrinsics must have shape \(1, 3, 3\)"):
        network.match(descriptors, torch.zeros(1, 4, 2), K, poses[:1])
    with pytest.raises(ShapeError, match=r"cam_from_anchor must have shape \(1, V, 4, 4\)"):
        network.match(descriptors, torch.zeros(1, 4, 2), K[:1], poses)


def test_precision_settings_are_put_back(network: ReferenceNetwork) -> None:
    before = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    with torch.autocast("cpu", dtype=torch.bfloat16):
        taps = network.features(torch.zeros(1, 3, 8, 8)).taps
    assert taps.half.dtype == torch.float32
    assert (torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32) == before


def test_the_page_of_differences_is_up_to_date() -> None:
    file = Path(__file__).resolve().parents[2] / "docs" / "differences.md"
    assert file.read_text(encoding="utf-8") == page()


def test_every_difference_is_told_in_full() -> None:
    assert [row.number for row in DIFFERENCES] == list(range(1, 28))
    for row in DIFFERENCES:
        told = (row.topic, row.paper, row.reference, row.deltas)
        assert all(text.strip() == text and len(text) > 3 for text in told), row.number
        assert not any("|" in text for text in told), row.number
    assert len({row.topic for row in DIFFERENCES}) == 27
    _, *lines = [line for line in page().splitlines() if line.startswith("| ")]
    assert [int(line.split("|")[1]) for line in lines] == list(range(1, 28))
    assert np.all([line.count("|") == 6 for line in lines])
