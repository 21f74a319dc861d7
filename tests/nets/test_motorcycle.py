"""The demo's stereo pair: its cameras agree with its true disparity, its pictures with both."""

from pathlib import Path

import numpy as np
import pytest
import skimage.data
import torch

from deltas_geom import PosedViews, pixel_grid, project, unproject
from deltas_nets.captures.motorcycle import SIZE, StereoPair, motorcycle
from deltas_nets.rooms.textures import PICTURES


@pytest.fixture(scope="module")
def pair() -> StereoPair:
    return motorcycle()


@pytest.fixture(scope="module")
def views(pair: StereoPair) -> PosedViews:
    frames = (pair.left, pair.right)
    return PosedViews(
        torch.stack([torch.tensor(frame.K) for frame in frames]),
        torch.stack([torch.tensor(frame.cam_from_world) for frame in frames]),
    )


def test_true_depth_reprojects_by_the_true_disparity(pair: StereoPair, views: PosedViews) -> None:
    with np.load(Path(skimage.data.__file__).parent / "motorcycle_disp.npz") as content:
        disparity = torch.tensor(content["arr_0"]).double().flatten()
    depth = torch.tensor(pair.depth).double().flatten()
    known = depth > 0
    assert torch.equal(known, disparity.isfinite())
    pixels = pixel_grid(SIZE, dtype=torch.float64)[known]
    points = unproject(views.select(0), pixels[None], depth[known][None])[0]
    right = project(views, points).pixels[1]
    expected = pixels - torch.stack([disparity[known], torch.zeros(int(known.sum()))], dim=-1)
    assert (right - expected).abs().max() < 1e-3  # px, depth is float32


def test_colours_agree_where_the_disparity_says(pair: StereoPair) -> None:
    left = pair.left.read_image().astype(float).mean(-1)
    right = pair.right.read_image().astype(float).mean(-1)
    with np.load(Path(skimage.data.__file__).parent / "motorcycle_disp.npz") as content:
        disparity = content["arr_0"]
    rows, columns = np.nonzero(np.isfinite(disparity))
    there = np.rint(columns - disparity[rows, columns]).astype(int)
    inside = there >= 0
    rows, columns, there = rows[inside], columns[inside], there[inside]
    shifted = np.minimum(there + 5, SIZE[1] - 1)
    error = np.abs(left[rows, columns] - right[rows, there]).mean()
    assert error < 0.6 * np.abs(left[rows, columns] - right[rows, shifted]).mean()


def test_depth_is_metric_and_plausible(pair: StereoPair) -> None:
    known = pair.depth[pair.depth > 0]
    assert known.min() > 2.0
    assert known.max() < 6.5
    assert (pair.depth > 0).mean() > 0.85


def test_no_training_texture_comes_from_the_pair() -> None:
    assert not [name for name in PICTURES if "motorcycle" in str(name)]
