"""Small trainings on scenes in ScanNet's layout, which conftest.py writes."""

from dataclasses import replace
from pathlib import Path

import torch

from deltas_geom import in_image, project, unproject
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.config import DataConfig, DetectorConfig, MatcherConfig, NetworkConfig, TrainConfig
from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.datasets.scannet import ScanNetViewSets, open_scannet
from deltas_nets.losses.targets import read_nearest

SIZE = (48, 64)
SCANNET = ScanNetConfig(gap=2)
TINY = TrainConfig(
    network=NetworkConfig(
        detector=DetectorConfig(num_keypoints=48), matcher=MatcherConfig(num_samples=32)
    ),
    data=DataConfig(source="scannet", height=48, width=64, workers=0),
    sizes=((48, 64),),
    steps=4,
    batch_size=2,
    warmup=2,
    min_views=3,
    max_views=3,
    num_keypoints=48,
)


def tiny(root: Path, **more: object) -> TrainConfig:
    scannet = replace(SCANNET, root=str(root), **more)  # type: ignore[arg-type]
    return replace(TINY, data=replace(TINY.data, scannet=scannet))


def opened(config: ScanNetConfig, split: str = "train", **more: object) -> ScanNetViewSets:
    return open_scannet(config, split, **{"num_views": 3, "image_size": SIZE, **more})  # type: ignore[arg-type]


def view_sets(tuples: ScanNetViewSets) -> list[tuple[str, ViewSet]]:
    return [tuples.view_set(index) for index in range(len(tuples))]


def agreeing_share(item: PosedImages, *, within: float = 0.03) -> float:
    """Share of the anchor's pixels whose depth is that of source 1, of those it sees."""
    height, width = item.depth.shape[-2:]
    pixels = torch.cartesian_prod(torch.arange(4.0, width - 4, 3), torch.arange(4.0, height - 4, 3))
    depth = read_nearest(item.depth[:1], pixels[None])
    points = unproject(item.views.select(0), pixels[None], depth)[0]
    there = project(item.views.select(1), points)
    surface = read_nearest(item.depth[1:2], there.pixels)[0]
    inside = in_image(there.pixels[0], image_size=(height, width))
    used = inside & there.in_front[0] & (surface > 0) & (depth[0] > 0)
    ratio = there.depth[0] / surface.clamp_min(1e-6)
    seen = used & (ratio < 1 + within)  # not hidden by something nearer
    assert seen.sum() > 0.5 * used.sum()
    return float((ratio[seen] > 1 - within).float().mean())


def overwrite(file: Path, content: str | bytes) -> None:
    file.unlink()  # or the link would be followed
    file.write_bytes(content if isinstance(content, bytes) else content.encode())


def written_list(tmp_path: Path, *lines: str, name: str = "list.txt") -> Path:
    file = tmp_path / name
    file.write_text("\n".join(lines))
    return file
