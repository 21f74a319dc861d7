"""The densifier of `deltas-small` with the best points there can be, and with none."""

from collections.abc import Sequence

import numpy as np
import torch

from deltas_geom.cameras.pixels import resize_pixels
from deltas_nets.baselines.densified import densified, densifier_record
from deltas_nets.baselines.named import Named
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.measured import OfSensor
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.errors import UserError
from deltas_nets.predict.depth_map import DepthMap, KeypointDepths, PredictConfig, Wanted
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.predict.ours import DeltasPredictor, work_size_of
from deltas_nets.weights_file import load_model

COUNT = 512
"""Points: the paper's "512 (GT)", in its table 2."""
NEAR = 1.5
"""Pixels at the work size: a keypoint takes the sensor's depth of a place so near."""


class TruePoints(Named):
    """Sensor depth at 512 keypoints of the anchor, through the densifier.

    Args:
        device: where to compute.
    """

    name = "true-points"

    def __init__(self, device: str | torch.device = "cpu") -> None:
        self.encode = EncodedFrames(load_model(device=device))
        self._capture: Capture | None = None

    def check_asked(
        self, config: PredictConfig, capture: Capture, view_sets: Sequence[ViewSet]
    ) -> None:
        """Every anchor has sensor depth, in metres as the poses."""
        super().check_asked(config, capture, view_sets)
        if not capture.metric:
            what = f"{self.name} reads depth in metres, and the poses are in another unit"
            raise UserError(what, capture.path, "give --scale, or use other weights")
        for views in view_sets:
            if capture.frame(views.anchor).depth_path is None:
                what = f"{self.name} needs sensor depth, and frame {views.anchor} has none"
                raise UserError(what, capture.path, "use other weights")
        self._capture = capture

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """Of the densifier."""
        return densifier_record(name_or_file)

    @torch.inference_mode()
    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame; the others only tell in which unit it is seen."""
        self.refuse_measured(wanted)
        assert self._capture is not None, "check_asked comes first"
        anchor, work_size = wanted.anchor, work_size_of(wanted.anchor, wanted.config)
        position = list(self._capture.frames).index(anchor.id)
        true = OfSensor(self._capture, deviation=0.0)(position)
        assert true is not None  # checked
        _, encoded = self.encode([anchor], work_size=work_size)
        keypoints = self.encode.model.detector(
            encoded.features, image_size=work_size, num_keypoints=COUNT
        )
        pixels = keypoints.pixels[0].cpu()
        seen = torch.from_numpy(true.pixels)
        seen = resize_pixels(seen, old_size=anchor.image_size, new_size=work_size)
        depth = _nearest(pixels.double(), seen, torch.from_numpy(true.depth))
        depth = depth * _unit(wanted.frames, self._capture)
        points = KeypointDepths(pixels.float(), depth.float(), work_size)
        return densified(self.encode, wanted, points)


class NoPoints(DeltasPredictor):
    """`deltas-small` without any point: one image, and depth as it mostly is in rooms.

    Args:
        device: where to compute.
    """

    def __init__(self, device: str | torch.device = "cpu") -> None:
        super().__init__(load_model(device=device), without_points=True)

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """Of the densifier."""
        return densifier_record(name_or_file)


def _nearest(pixels: torch.Tensor, seen: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """Depth ``(N,)`` of the places ``(D, 2)`` nearest to pixels ``(N, 2)``; 0 if none is near."""
    if len(seen) == 0:
        return pixels.new_zeros(len(pixels))
    from scipy.spatial import cKDTree

    far, index = cKDTree(seen.numpy()).query(pixels.numpy(), distance_upper_bound=NEAR)
    there = torch.from_numpy(np.where(np.isfinite(far), index, 0))
    return torch.where(torch.from_numpy(far).isfinite(), depth[there], 0.0)


def _unit(frames: Sequence[Frame], capture: Capture) -> float:
    """Metres that the network sees a metre of the capture as: from the way between two cameras."""
    for frame in frames[1:]:
        own = [capture.frame(each.id) for each in (frames[0], frame)]
        walked = _way(*own)
        if walked > 0:
            return _way(frames[0], frame) / walked
    return 1.0


def _way(one: Frame, other: Frame) -> float:
    centres = [
        -frame.cam_from_world[:3, :3].T @ frame.cam_from_world[:3, 3] for frame in (one, other)
    ]
    return float(np.linalg.norm(centres[0] - centres[1]))
