"""Exact depth of simple things, for fusion."""

from pathlib import Path

import numpy as np
import torch

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.fuse import DepthView
from deltas_nets.outputs.prepare import prepare_output
from deltas_nets.outputs.products import FrameOutput

K = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]], dtype=torch.float64)
SIZE = (48, 64)


def looking_at(target: torch.Tensor, centre: torch.Tensor) -> torch.Tensor:
    """cam_from_world of a camera at a centre whose axis meets a target."""
    ahead = torch.nn.functional.normalize(target - centre, dim=0)
    aside = torch.tensor([0.1, 1.0, 0.05], dtype=torch.float64)
    right = torch.nn.functional.normalize(torch.linalg.cross(aside, ahead), dim=0)
    rotation = torch.stack((right, torch.linalg.cross(ahead, right), ahead))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return pose


def view_of(depth: torch.Tensor, pose: torch.Tensor | None = None, std: float = 0.01) -> DepthView:
    colors = torch.full((*depth.shape, 3), 90, dtype=torch.uint8)
    pose = torch.eye(4, dtype=torch.float64) if pose is None else pose
    return DepthView(depth.float(), torch.full_like(depth, std).float(), colors, K, pose)


def wall(distance: float, *, x: float = 0.0, std: float = 0.01) -> DepthView:
    """A wall that faces the camera, which stands x to the right of the world's origin."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return view_of(torch.full(SIZE, distance), pose, std)


def sphere_views(
    radius: float = 0.4, *, at: tuple[float, float, float] = (0.0, 0, 0)
) -> list[DepthView]:
    """A sphere from 14 sides, 2 m away."""
    middle = torch.tensor(at, dtype=torch.float64)
    sides = [[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
    sides += [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    views = []
    for side in torch.tensor(sides, dtype=torch.float64):
        pose = looking_at(middle, middle + 2 * torch.nn.functional.normalize(side, dim=0))
        view = view_of(torch.ones(SIZE), pose)
        rays = view.rays().double()
        centre = pose[:3, :3] @ middle + pose[:3, 3]
        along, square = rays @ centre, rays.square().sum(dim=-1)
        root = along.square() - square * (centre @ centre - radius**2)
        depth = torch.where(root > 0, (along - root.clamp_min(0).sqrt()) / square, 0.0)
        views.append(view._replace(depth=depth.float()))
    return views


def write_maps(
    folder: Path, capture_path: Path, depth: float = 2.5, confidence: float = 0.9
) -> Capture:
    """What `deltas depth` would have left of a small capture whose frames all see a wall."""
    capture = open_capture(capture_path)
    ids = list(capture.frames)
    settings = {
        "capture": {"cameras": capture.fingerprint()},
        "view_sets": [[id, []] for id in ids],
    }
    head = {"unit": "metre", "scaled_by": 1.0}
    out = prepare_output(folder, settings=settings, frame_ids=ids, head=head)
    for id in ids:
        frame = capture.frame(id)
        maps = np.full(frame.image_size, depth), np.full(frame.image_size, confidence)
        points = np.zeros((1, 3))
        out.write_frame(FrameOutput(frame, *maps, points, points.astype(np.uint8)), {})
    out.write_summary("complete")
    return capture
