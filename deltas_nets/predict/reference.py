"""Depth of frames by the reference network, prepared as its authors' test program did.

Images are resized linearly to 240 x 320, each axis by itself and without antialiasing, as the
published weights saw them; one camera matrix stands for all views. The network searches 0.5 to
10 m and states no uncertainty.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_geom.cameras.poses import relative_pose
from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import SMALLEST_BASELINE
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.errors import UserError
from deltas_nets.network.lite.detector import CELL
from deltas_nets.predict.depth_map import (
    DepthMap,
    KeypointDepths,
    PredictConfig,
    Wanted,
    frames_of,
    point_cloud,
    resized,
)
from deltas_nets.predict.views_alone import ViewsAlone
from deltas_nets.reference import ReferenceNetwork, evaluation_input
from deltas_nets.reference.segments import FAR, NEAR
from deltas_nets.reference.settings import PUBLISHED
from deltas_nets.weights_file import sha256_of, weights_file

DEPTH_RANGE = (NEAR, FAR)
"""What is searched, metres: the network has no other."""
WORK_SIZE = (240, 320)
"""(height, width) that the network was made for; other multiples of 8 can be asked for."""
SAME_CAMERA = 0.5
"""Pixels at the work size by which the cameras of a view set may differ."""
SEED = 1
"""Of the points that are drawn at random, the same for every frame."""


class ReferenceInput(NamedTuple):
    """One anchor and V sources as the network wants them.

    Attributes:
        images: ``(1 + V, 3, H, W)`` in [-1, 1].
        intrinsics: ``(1, 3, 3)`` of all views.
        cam_from_anchor: ``(1, V, 4, 4)`` metres.
    """

    images: Tensor
    intrinsics: Tensor
    cam_from_anchor: Tensor


class ReferenceDepth(NamedTuple):
    """What the network says of an anchor; it says nothing of how sure it is.

    Attributes:
        depth: ``(1, H, W)`` metres, unbounded: may be negative.
        pixels: ``(N, 2)`` key points of the anchor.
        point_depth: ``(N,)`` their triangulated depth, metres; 0 where no source has the point in
            range or it lies outside `DEPTH_RANGE`, so that the dense map does not rest on it.
    """

    depth: Tensor
    pixels: Tensor
    point_depth: Tensor


class ReferencePredictor(ViewsAlone):
    """The reference network; it looks at all images of a view set together and remembers none.

    See :class:`deltas_nets.predict.predictor.Predictor`.

    Args:
        network: from :func:`deltas_nets.reference.load`, on any device.
        settings: what the supplement varies.
    """

    states_confidence = False
    takes_larger = False
    called = "the reference network"

    def __init__(self, network: ReferenceNetwork, settings: NetworkSettings = PUBLISHED) -> None:
        self.network = network
        self.settings = settings

    def varied(self, settings: NetworkSettings) -> "ReferencePredictor":
        """It has all of them."""
        return ReferencePredictor(self.network, replace(self.settings, **settings.given()))

    def check_asked(
        self, config: PredictConfig, capture: Capture, view_sets: Sequence[ViewSet]
    ) -> None:
        """It has one depth range and one camera, takes multiples of 8 and states no confidence."""
        if config.depth_range != DEPTH_RANGE:
            what = "the reference network searches {:g} to {:g} m".format(*DEPTH_RANGE)
            raise UserError(what, "--depth-range", "leave it out")
        self.refuse_confidence(config)
        work_size = config.work_size or WORK_SIZE
        check_work_size(work_size)
        for views in view_sets:
            check_cameras(frames_of(capture, views), work_size=work_size)

    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame from all of them; it takes no measured depth."""
        self.refuse_measured(wanted)
        work_size, size = wanted.config.work_size or WORK_SIZE, wanted.size
        found = predict_reference(
            self.network, wanted.frames, work_size=work_size, settings=self.settings
        )
        depth = np.maximum(resized(found.depth, size), 0)  # below 0 it is no depth
        points, colors = point_cloud(wanted.anchor, depth, size, work_size)
        keypoints = KeypointDepths(found.pixels, found.point_depth, work_size)
        return DepthMap(depth, None, points, colors, keypoints)

    def network_record(self) -> dict[str, Any]:
        """Its name in records, and what its program did not have."""
        other = self.settings.given().items() - PUBLISHED.given().items()
        return {"name": "published", **dict(sorted(other))}

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """The file's fingerprint."""
        return {
            "name": name_or_file,
            "sha256": sha256_of(weights_file(name_or_file)),
            "origin": "the published checkpoint",
        }


def check_cameras(frames: Sequence[Frame], *, work_size: tuple[int, int]) -> None:
    """Whether one camera matrix can stand for all frames.

    Raises:
        UserError: a frame has another one than the first.
    """
    anchor = _intrinsics(frames[0], work_size)
    for frame in frames[1:]:
        if not torch.allclose(_intrinsics(frame, work_size), anchor, rtol=0, atol=SAME_CAMERA):
            raise UserError(
                f"the reference network knows one camera, frame {frame.id} has another than "
                f"frame {frames[0].id}",
                frame.image_path,
                "leave the frame out of the view sets, or use other weights",
            )


def predict_reference(
    network: ReferenceNetwork,
    frames: Sequence[Frame],
    *,
    work_size: tuple[int, int] = WORK_SIZE,
    settings: NetworkSettings = PUBLISHED,
) -> ReferenceDepth:
    """Depth of the first frame from all of them.

    Args:
        network: from :func:`deltas_nets.reference.load`, on any device.
        frames: the anchor and its sources, of one camera (:func:`check_cameras`).
        work_size: (height, width) that the network sees, multiples of 8.
        settings: what the supplement varies.

    Raises:
        UserError: an image cannot be read.
        ShapeError: a side is no multiple of 8.
    """
    device = next(network.parameters()).device
    given = ReferenceInput(*(part.to(device) for part in load_input(frames, work_size)))
    generator = torch.Generator().manual_seed(SEED)
    prediction = network.predict(*given, settings=settings, generator=generator)
    matched = prediction.matched
    z = matched.points_3d[0, :, 2]
    used = (matched.in_range != 0).any(dim=1)[0] & (z > NEAR) & (z < FAR)
    return ReferenceDepth(
        prediction.depth[0], prediction.keypoints[0], torch.where(used, z, torch.zeros_like(z))
    )


def load_input(frames: Sequence[Frame], work_size: tuple[int, int] = WORK_SIZE) -> ReferenceInput:
    """Images, the anchor's camera and the relative poses of an anchor and its sources.

    Raises:
        UserError: an image cannot be read.
    """
    images = torch.cat([_resized_image(frame, work_size) for frame in frames])
    # In float64: what is left when poses far from the world's origin are subtracted is parallax.
    in_world = torch.from_numpy(np.stack([frame.cam_from_world for frame in frames]))
    poses = relative_pose(in_world[1:], in_world[:1])
    apart = poses[:, :3, 3].norm(dim=-1) > SMALLEST_BASELINE
    poses[:, :3, 3] *= apart[:, None]  # the rest is rounding, and would pass for parallax
    K = _intrinsics(frames[0], work_size)
    return ReferenceInput(evaluation_input(images), K[None].float(), poses[None].float())


def check_work_size(work_size: tuple[int, int]) -> None:
    """Whether the network can run at a size.

    Raises:
        UserError: a side is no multiple of 8.
    """
    if work_size[0] % CELL or work_size[1] % CELL:
        raise UserError(
            f"the reference network takes multiples of {CELL}",
            "--work-size {} {}".format(*work_size),
            "leave it out to use {} {}".format(*WORK_SIZE),
        )


def _intrinsics(frame: Frame, work_size: tuple[int, int]) -> Tensor:
    K = torch.from_numpy(frame.K.copy())
    return resize_intrinsics(K, old_size=frame.image_size, new_size=work_size)


def _resized_image(frame: Frame, work_size: tuple[int, int]) -> Tensor:
    """``(1, 3, H, W)`` RGB in [0, 1]."""
    image = torch.from_numpy(frame.read_image().copy()).permute(2, 0, 1)[None].float()
    return F.interpolate(image, size=work_size, mode="bilinear", align_corners=False) / 255
