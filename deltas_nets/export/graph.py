"""The network as a graph of tensors, with everything but images and cameras fixed.

It is traced with tensors that hold no values, so that no number of theirs can end up in it: what
depended on a value would raise.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.export import ExportedProgram

from deltas_geom import PosedViews
from deltas_geom.checks import check_depth_range
from deltas_geom.numerics.arithmetic import outside_autocast
from deltas_nets.network.conv_norm import with_affine_norms
from deltas_nets.network.deltas import Deltas

IMAGE_RANGE = (0.0, 1.0)
"""Of the images: a graph cannot refuse others, and makes confident nonsense of them."""
MEANING = {
    "images": "(1, V, 3, H, W) RGB in [0, 1], not 0..255, not normalised; view 0 is the anchor",
    "K": "(1, V, 3, 3) pixels of these images, the top-left pixel's centre at (0, 0)",
    "cam_from_world": "(1, V, 4, 4) OpenCV axes, metres",
}
"""The graph's inputs, in order."""
INPUTS = tuple(MEANING)
OUTPUTS = ("depth", "std", "keypoints", "points")
"""Names of its outputs, in order."""


@dataclass(frozen=True)
class ExportConfig:
    """What is fixed in an exported network."""

    num_views: int = 3
    """Views, the anchor included."""
    num_points: int = 512
    """Points that are triangulated."""
    image_size: tuple[int, int] = (240, 320)
    """(height, width) of the images, pixels."""
    depth_range: tuple[float, float] = (0.5, 10.0)
    """Nearest and farthest depth searched, metres."""
    refinement: int = 8
    """Samples per bin of inverse depth, at most. The network takes as many as the widest view
    needs, up to its config's max_refinement, 8 by default; a file takes the time of these always,
    and with fewer it is another network where views are too wide for them."""

    def __post_init__(self) -> None:
        if self.num_views < 2:
            raise ValueError(f"there must be 2 views or more, got {self.num_views}")
        if self.num_points < 8:
            raise ValueError(f"there must be 8 points or more, got {self.num_points}")
        if self.num_points > self.image_size[0] * self.image_size[1]:
            raise ValueError(f"there are fewer pixels than points, got {self.num_points} points")
        if min(self.image_size) < 32:
            raise ValueError(f"images must be 32 x 32 pixels or more, got {self.image_size}")
        if self.refinement < 1:
            raise ValueError(f"refinement must be at least 1, got {self.refinement}")
        check_depth_range(self.depth_range)


class FixedDeltas(nn.Module):
    """A network with one depth range and number of points, from tensors to tensors.

    Args:
        model: stays as it is.
        config: what is fixed.
    """

    def __init__(self, model: Deltas, config: ExportConfig) -> None:
        super().__init__()
        self.model = model
        self.config = config

    def forward(self, images: Tensor, K: Tensor, cam_from_world: Tensor) -> dict[str, Tensor]:
        """Depth of view 0.

        Args:
            images: ``(1, V, 3, H, W)`` RGB in [0, 1]; view 0 is the anchor.
            K: ``(1, V, 3, 3)`` intrinsics in pixels.
            cam_from_world: ``(1, V, 4, 4)`` poses.

        Returns:
            Those of OUTPUTS: depth and std ``(1, 1, H, W)`` metres, keypoints ``(1, N, 2)`` pixels
            of the anchor, points ``(1, N, 3)`` in the world, (0, 0, 0) where there is none.
        """
        prediction = self.model(
            images,
            PosedViews(K, cam_from_world),
            self.config.depth_range,
            num_keypoints=self.config.num_points,
            refinement=self.config.refinement,
        )
        return {
            "depth": prediction.depth,
            "std": prediction.std,
            "keypoints": prediction.keypoints.pixels,
            "points": prediction.points.points,
        }


def trace(model: Deltas, config: ExportConfig) -> ExportedProgram:
    """The graph of a network.

    Args:
        model: in eval mode, on the device that the graph is to run on.
        config: what is fixed.

    Raises:
        ValueError: the network is in training mode.
    """
    if model.training:
        raise ValueError("the network is in training mode: call model.eval() before exporting")
    device = next(model.parameters()).device
    views, (height, width) = config.num_views, config.image_size
    inputs = (
        torch.zeros(1, views, 3, height, width, device=device),
        torch.eye(3, device=device).repeat(1, views, 1, 1),
        torch.eye(4, device=device).repeat(1, views, 1, 1),
    )
    # A region within the program that is exempt from autocast could not be loaded again.
    with outside_autocast(device.type), torch.no_grad():
        return torch.export.export(FixedDeltas(with_affine_norms(model), config).eval(), inputs)


def without_paths(program: ExportedProgram) -> ExportedProgram:
    """Remove from a program, in place, where our source files were."""
    for node in _nodes(program):
        node.meta.pop("stack_trace", None)
    return program


def _nodes(program: ExportedProgram) -> Iterator[torch.fx.Node]:
    for module in program.graph_module.modules():
        if isinstance(module, torch.fx.GraphModule):
            yield from module.graph.nodes


def parameters_sha256(model: Deltas) -> str:
    """Fingerprint of the names, types, shapes and values of all weights."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
