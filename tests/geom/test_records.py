"""Records of tensors: saved, copied, batched, mapped, moved and printed, each of them."""

import copy
import io
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from operations import RECORDS, chosen, followed, inputs_in, is_real, tensors_of
from torch.utils.data import default_collate

import deltas_geom as geom
from deltas_geom.testing import seeded_scene

HALF = (torch.float16, torch.bfloat16)


def test_every_public_record_is_tried() -> None:
    assert set(RECORDS) == {n for n in geom.__all__ if hasattr(getattr(geom, n), "_fields")}


@pytest.fixture(params=sorted(RECORDS))
def record(request: pytest.FixtureRequest) -> Any:
    operation = RECORDS[request.param]
    return operation(**followed(chosen(operation, inputs_in(torch.float32))))


def assert_same(ours: Any, theirs: Any) -> None:
    assert type(ours) is type(theirs)
    for one, other in zip(ours, theirs, strict=True):
        assert (one is None and other is None) or torch.equal(one, other)


def test_a_record_comes_back_from_files_copies_and_loaders(record: Any) -> None:
    file = io.BytesIO()
    torch.save(record, file)
    file.seek(0)
    assert_same(torch.load(file), record)
    plain = record.detach()
    assert not any(tensor.requires_grad for tensor in tensors_of(plain))
    assert_same(pickle.loads(pickle.dumps(plain)), plain)
    assert_same(copy.deepcopy(plain), plain)
    batch = default_collate([plain, plain])
    assert type(batch) is type(plain)
    assert all(x.shape == (2, *y.shape) for x, y in zip(batch, plain, strict=True))
    mapped = torch.func.vmap(lambda each: each._replace())(batch)
    assert_same(mapped, batch)


def test_a_record_moves_and_prints_as_a_tensor(record: Any) -> None:
    assert record.dtype == torch.float32 and record.device == torch.device("cpu")
    for moved in (
        record.to(torch.float64),
        record.to(dtype=torch.float64),
        record.to("cpu", torch.float64, True),
        record.to(torch.ones(1, dtype=torch.float64)),
    ):
        assert type(moved) is type(record) and moved.dtype == torch.float64
        for ours, theirs in zip(moved, record, strict=True):
            assert ours.dtype == (torch.float64 if is_real(theirs) else theirs.dtype)
    assert record.to("meta").device.type == "meta"
    assert all(tensor.is_meta for tensor in tensors_of(record.to("meta")))
    text = repr(record)
    assert text.startswith(f"{type(record).__name__}(") and text.endswith("float32 cpu")
    assert len(text) < 400 and "tensor" not in text and "." not in text
    for field, tensor in record._asdict().items():
        assert f"{field} {tuple(tensor.shape)}" in text
    repr(record.to("meta"))
    torch.func.vmap(lambda each: (repr(each), each[0])[1])(default_collate([record.detach()]))


def test_a_record_prints_how_many_there_are_of_each_status() -> None:
    ones = torch.ones(3)
    status = torch.tensor([0, 4, 0], dtype=torch.int8)
    points = geom.Triangulation(
        torch.ones(3, 3), ones[None], status, status == 0, ones, ones, None, ones[None]
    )
    assert repr(points) == (
        "Triangulation(points (3, 3), depth (1, 3), status (3,) 2 OK 1 BEHIND_CAMERA, "
        "valid (3,) 2 True, residual (3,), parallax (3,), covariance None, "
        "errors (1, 3)) float32 cpu"
    )


@pytest.mark.parametrize("half", HALF, ids=str)
def test_values_of_cameras_in_half_precision_are_checked(half: torch.dtype) -> None:
    inputs = inputs_in(half)
    views = geom.PosedViews(inputs["K"], inputs["poses"])
    views.check_values()
    for wrong in (
        views._replace(cam_from_world=1.1 * views.cam_from_world),
        views.to(torch.int64),
        geom.PosedViews(views.K.long(), views.cam_from_world),
    ):
        with pytest.raises(ValueError, match=r"rigid|use K\.float\(\)"):
            wrong.check_values()


def test_posed_views_of_arrays_are_refused_at_once() -> None:
    K, poses = np.eye(3)[None], np.eye(4)[None]
    with pytest.raises(TypeError, match=r"K must be .*, got ndarray: use torch\.from_numpy\(K\)"):
        geom.PosedViews(K, poses)
    with pytest.raises(TypeError, match=r"cam_from_world must be .*, got list: use torch\.stack"):
        geom.PosedViews(torch.eye(3)[None], list(torch.eye(4)[None]))
    views = geom.PosedViews(torch.eye(3)[None], torch.eye(4)[None])
    with pytest.raises(TypeError, match=r"proj must be .*, got PosedViews: use proj\.proj"):
        geom.triangulate(views, torch.zeros(1, 5, 2))
    with pytest.raises(TypeError, match=r"views must be PosedViews, got Tensor"):
        geom.project(views.proj, torch.zeros(5, 3))


def test_lenses_and_diagnoses_come_back_from_files() -> None:
    """No records, but kept beside checkpoints as these are."""
    views, _, pixels = seeded_scene(1, num_views=3, num_points=9)
    lens = geom.Lens.from_opencv(views.K, torch.tensor([-0.1, 0.02, 0.0, 0.0]).expand(3, 4))
    found = geom.diagnose(views, pixels)
    file = io.BytesIO()
    torch.save({"lens": lens, "diagnosis": found}, file)
    file.seek(0)
    loaded = torch.load(file)
    assert loaded["lens"].model == lens.model and torch.equal(loaded["lens"].K, lens.K)
    assert loaded["diagnosis"].cause is found.cause and str(loaded["diagnosis"]) == str(found)
