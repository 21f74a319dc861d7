"""Lenses that bend lines: what the network sees is straight, what is written lies on the photo."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from deltas_geom import Lens as GeomLens
from deltas_geom.cameras.pixels import pixel_grid
from deltas_nets.captures import straight as straight_module
from deltas_nets.captures.frame import Frame, Lens
from deltas_nets.captures.images import Span
from deltas_nets.captures.straight import StraightFrame, photo_pixels, pixels_of_photo, straight
from deltas_nets.predict.depth_map import (
    DepthMap,
    KeypointDepths,
    PredictConfig,
    Wanted,
    point_cloud,
)
from deltas_nets.predict.look import look
from deltas_nets.predict.reach import Reach

SIZE = (96, 128)
K = np.array([[70.0, 0, 60], [0, 72, 50], [0, 0, 1]])
LENSES = {
    "barrel": Lens("OPENCV", (-0.2, 0.03, 0.001, -0.002)),
    "pincushion": Lens("SIMPLE_RADIAL", (0.08,)),
    "phone": Lens("FULL_OPENCV", (0.1, -0.2, 0.0, 0.001, 0.1, 0.0, 0.0, 0.0)),
    "fisheye": Lens("OPENCV_FISHEYE", (0.02, -0.01, 0.0, 0.0)),
    "division": Lens("SIMPLE_DIVISION", (-0.1,)),
}
EACH = pytest.mark.parametrize("name", LENSES)


def pattern(rays: np.ndarray) -> np.ndarray:
    """Something smooth to see in a direction, ``(..., 3)`` in 0 to 255."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    return np.stack([127 + 100 * np.sin(3 * x), 127 + 100 * np.cos(2 * y), 127 + 90 * x * y], -1)


def rays_of(lens: Lens, K: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    found = GeomLens(torch.tensor(K), torch.tensor(lens.coefficients).double(), lens.model)
    seen = found.unproject(pixel_grid(size, dtype=torch.float64))
    assert seen.valid.all()
    return seen.rays.numpy().reshape(*size, 3)


def photo_of(name: str, folder: Path) -> Frame:
    lens, file = LENSES[name], folder / f"{name}.png"
    image = pattern(rays_of(lens, K, SIZE)).clip(0, 255).round().astype(np.uint8)
    Image.fromarray(image).save(file)
    return Frame(name, file, SIZE, K, np.eye(4), lens=lens)


@EACH
def test_a_straight_image_shows_what_its_rays_see(name: str, tmp_path: Path) -> None:
    frame = straight(photo_of(name, tmp_path))
    assert isinstance(frame, StraightFrame) and frame.lens is None
    for size in (frame.image_size, (48, 64), (33, 80)):
        image = frame.read_image() if size == frame.image_size else frame.read_resized(size)
        x, y = pixel_grid(size).reshape(*size, 2).double().unbind(-1)
        across, down = frame.image_size[1] / size[1], frame.image_size[0] / size[0]
        at = np.stack([(x + 0.5) * across - 0.5, (y + 0.5) * down - 0.5, np.ones(size)], -1)
        rays = at @ np.linalg.inv(frame.K).T
        # Where the photo shows it, and not its last pixel, which is repeated beyond it.
        lens = GeomLens(
            torch.tensor(K), torch.tensor(frame.photo.lens.coefficients).double(),
            frame.photo.lens.model,
        )  # fmt: skip
        pixels = lens.project(torch.tensor(rays.reshape(-1, 3))).pixels.reshape(*size, 2)
        inside = ((pixels > 2) & (pixels < torch.tensor([125.0, 93.0]))).all(-1).numpy()
        error = np.abs(image - pattern(rays))[inside]
        assert inside.mean() > 0.6 and error.mean() < 1.5 and np.percentile(error, 99) < 8


@EACH
def test_large_images_are_straightened_by_strips(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = straight(photo_of(name, tmp_path))
    assert isinstance(frame, StraightFrame)
    most = []

    def seen() -> list[np.ndarray]:
        straight_module._grid.cache_clear()
        straight_module._places.cache_clear()
        return [frame.read_image(), frame.read_resized((50, 70)), pixels_of_photo(frame, SIZE)]

    at_once = seen()
    project = GeomLens.project
    monkeypatch.setattr(
        GeomLens, "project", lambda lens, rays: most.append(len(rays)) or project(lens, rays)
    )
    monkeypatch.setattr(straight_module, "_AT_ONCE", 1000)
    for whole, strips in zip(at_once, seen(), strict=True):
        assert np.array_equal(whole, strips)
    assert max(most) <= 1000
    # What is large is not straightened finer than the photo.
    usual, size = frame.read_resized(SIZE), frame.image_size
    monkeypatch.setattr(straight_module, "_ENOUGH", 100)
    most.clear()
    straight_module._grid.cache_clear()
    large = frame.read_resized(SIZE)
    assert sum(most) == max(size[0], SIZE[0]) * max(size[1], SIZE[1])
    assert np.abs(large.astype(float) - usual.astype(float)).mean() < 2


@EACH
def test_maps_of_straight_images_lie_on_the_photo(name: str, tmp_path: Path) -> None:
    frame = straight(photo_of(name, tmp_path))
    assert isinstance(frame, StraightFrame)
    grid = pixel_grid(frame.image_size, dtype=torch.float64).numpy()
    rays = np.c_[grid, np.ones(len(grid))] @ np.linalg.inv(frame.K).T
    for size in (SIZE, (48, 64)):
        place = pixels_of_photo(frame, size)
        assert place.shape == size and (place >= 0).mean() > 0.97
        change = np.diag([size[1] / 128, size[0] / 96, 1.0])
        change[:2, 2] = (change.diagonal()[:2] - 1) / 2
        seen = rays_of(frame.photo.lens, change @ K, size)
        slopes = seen[..., :2] / seen[..., 2:]
        off = np.abs(rays[place][..., :2] - slopes)[place >= 0]
        assert (off * frame.K[0, 0]).max() < 0.51  # the nearest pixel
    there = torch.tensor([[3.0, 5.0], [60.0, 40.0]])
    back = photo_pixels(frame, there, frame.image_size, SIZE)
    column, row = back.round().long().T
    again = pixels_of_photo(frame, SIZE)[row.numpy(), column.numpy()]
    x, y = again % frame.image_size[1], again // frame.image_size[1]
    assert np.abs(np.stack([x, y], -1) - there.numpy()).max() <= 2


class Sees:
    """Depth that follows from the pixel's ray alone: a wall that is slanted."""

    def depth_map(self, wanted: Wanted) -> DepthMap:
        frame = wanted.anchor
        assert frame.lens is None and wanted.config.size is None
        grid = pixel_grid(frame.image_size, dtype=torch.float64)
        x, y = ((grid.numpy() - frame.K[:2, 2]) / np.diag(frame.K)[:2]).T
        depth = (2 / (1 + 0.15 * x + 0.1 * y)).reshape(frame.image_size).astype(np.float32)
        keypoints = KeypointDepths(grid[:5].float(), torch.ones(5), frame.image_size)
        log_std = torch.zeros(1, *frame.image_size)
        empty = np.zeros((0, 3))
        return DepthMap(depth, depth / 4, empty, empty.astype(np.uint8), keypoints, log_std)


@EACH
def test_depth_is_of_the_photos_pixels(name: str, tmp_path: Path) -> None:
    photo = photo_of(name, tmp_path)
    found = look(Sees(), [photo], PredictConfig(size=SIZE), Reach(0.5, 10.0))  # type: ignore[arg-type]
    rays = rays_of(photo.lens, K, SIZE)
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    true = 2 / (1 + 0.15 * x + 0.1 * y)
    known = found.depth > 0
    assert known.mean() > 0.97
    assert np.abs(found.depth - true)[known].max() < 0.02
    assert np.allclose(found.confidence, found.depth / 4)
    assert found.log_std is not None and found.log_std.shape == (1, *SIZE)


class SeesPoints(Sees):
    """With a point for every pixel of the straight image."""

    def depth_map(self, wanted: Wanted) -> DepthMap:
        found, frame = super().depth_map(wanted), wanted.anchor
        points, colors = point_cloud(frame, found.depth, frame.image_size, frame.image_size)
        return found._replace(points=points, colors=colors)


@pytest.mark.parametrize("name", ["barrel", "fisheye", "pincushion"])
def test_points_are_those_that_the_photo_shows(name: str, tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 5, -4, 3
    photo = replace(photo_of(name, tmp_path), cam_from_world=pose)
    reach = Reach(0.5, 10.0, unit=2.0)
    found = look(SeesPoints(), [photo], PredictConfig(), reach)  # type: ignore[arg-type]
    lens = GeomLens(
        torch.tensor(K), torch.tensor(photo.lens.coefficients).double(), photo.lens.model
    )
    pixels = lens.project(torch.from_numpy(found.points + pose[:3, 3])).pixels
    assert ((pixels > -0.51) & (pixels < torch.tensor([127.51, 95.51]))).all()
    straightened = np.prod(straight(photo).image_size)
    assert 0.6 * straightened < len(found.points) == len(found.colors) < straightened


def test_a_frame_without_a_lens_is_straight(tmp_path: Path) -> None:
    frame = replace(photo_of("phone", tmp_path), lens=None)
    assert straight(frame) is frame


def test_wide_fisheyes_are_cut_and_say_where(tmp_path: Path) -> None:
    K = np.array([[40.0, 0, 63.5], [0, 40, 47.5], [0, 0, 1]])
    lens = Lens("OPENCV_FISHEYE", (0.0,) * 4)
    wide = Frame("w", tmp_path / "w.png", SIZE, K, np.eye(4), lens=lens)
    frame = straight(wide)
    assert isinstance(frame, StraightFrame)
    sides = np.array(frame.image_size[::-1])
    assert np.allclose(frame.K[:2, 2], (sides - 1) / 2)  # as the lens is in the middle, too
    slopes = (sides / 2) / np.diag(frame.K)[:2]
    assert (slopes < np.tan(np.radians(61))).all()
    place = pixels_of_photo(frame, SIZE)
    assert place[48, 63] >= 0 and place[0, 0] == place[95, 127] == -1


def test_images_inside_of_a_file_are_read(tmp_path: Path) -> None:
    photo = photo_of("phone", tmp_path)
    inside = photo.image_path.read_bytes()
    (tmp_path / "all.bin").write_bytes(b"head" + inside + b"tail")
    packed = replace(photo, image_path=tmp_path / "all.bin", image_span=Span(4, len(inside)))
    packed.check_image()
    assert np.array_equal(packed.read_image(), photo.read_image())
