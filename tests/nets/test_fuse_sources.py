"""Depth with its camera: thinned images, bent ones, and depth cameras aside."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import MakeCapture
from PIL import Image
from torch.testing import assert_close

from deltas_geom import Lens
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.frame import Lens as FrameLens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.fuse import sources
from deltas_nets.fuse.sources import Sensed

SLOPE = 0.01  # m of depth in a pixel to the right


@pytest.fixture
def frame(make_capture: MakeCapture) -> Frame:
    """Its depth tells the column of each pixel: 1 m, and a centimetre a column."""
    frame = open_capture(make_capture()).frame("1")
    assert frame.depth_path is not None
    steps = np.tile(1000 + 10 * np.arange(64, dtype=np.uint16), (48, 1))
    Image.fromarray(steps).save(frame.depth_path)
    return replace(frame, depth_K=None)


def view_of(frame: Frame) -> sources.DepthView:
    return Sensed(Capture(Path(), Frames.of([frame]), {})).view(frame.id)


def columns_of(view: sources.DepthView) -> torch.Tensor:
    """Of the photo, as depth tells them."""
    return (view.depth.double() - 1) / SLOPE


@pytest.mark.parametrize("most", [48 * 64, 48 * 16, 300])
def test_a_thinned_map_has_the_camera_of_its_pixels(
    frame: Frame, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    monkeypatch.setattr(sources, "MOST_SENSED", most)
    view = view_of(frame)
    assert view.depth.numel() <= most
    pixels = (view.rays().double() @ torch.tensor(frame.K).T)[..., 0]
    assert_close(columns_of(view), pixels, rtol=0, atol=1e-4)


def test_a_bent_map_is_straightened(frame: Frame) -> None:
    bent = replace(frame, lens=FrameLens("SIMPLE_RADIAL", (0.2,)))
    view = view_of(bent)
    lens = Lens(torch.tensor(bent.K), torch.tensor([0.2]).double(), "SIMPLE_RADIAL")
    pixels = lens.project(view.rays().double().reshape(-1, 3)).pixels[:, 0]
    known = view.depth.reshape(-1) > 0
    assert known.float().mean() > 0.5
    off = columns_of(view).reshape(-1) - pixels
    assert off[known].abs().max() < 0.51  # the nearest pixel


def test_a_depth_camera_aside_gets_the_colours_that_the_photo_has_there(frame: Frame) -> None:
    pixels = np.zeros((48, 64, 3), dtype=np.uint8)
    pixels[:, 32:] = 200
    image = frame.image_path.with_suffix(".png")
    Image.fromarray(pixels).save(image)
    cam_from_depth = np.eye(4)
    cam_from_depth[0, 3] = 0.2
    aside = replace(frame, image_path=image, depth_K=frame.K, cam_from_depth=cam_from_depth)
    view = view_of(aside)
    points = view.points().double() + torch.tensor([0.2, 0, 0])
    column = (points @ torch.tensor(frame.K).T)[..., 0] / points[..., 2]
    sure = ((column - 31.5).abs() > 0.6) & (column < 63)
    assert ((view.colors[..., 0] == 200) == (column > 31.5))[sure].all()
    in_world = points @ torch.tensor(frame.cam_from_world)[:3, :3] - torch.tensor(
        frame.cam_from_world[:3, 3]
    )
    ours = view.points().double() @ view.world_from_cam[:3, :3].T + view.world_from_cam[:3, 3]
    assert_close(ours, in_world, rtol=0, atol=1e-5)
