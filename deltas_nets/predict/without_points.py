"""A map that rests on no point: what the densifier makes of one image, as a monocular network."""

import torch

from deltas_nets.captures.frame import Frame
from deltas_nets.network.known_depth import KnownDepth, as_points
from deltas_nets.predict.depth_map import DepthMap, KeypointDepths, PredictConfig, finished_map
from deltas_nets.predict.encoded_frames import EncodedFrames


@torch.inference_mode()
def map_without_points(
    encode: EncodedFrames, anchor: Frame, config: PredictConfig, *, work_size: tuple[int, int]
) -> DepthMap:
    """Depth of a frame by its image alone: the supplement's row of zero points.

    Args:
        encode: of a trained network, on any device.
        anchor: the frame.
        config: sizes, range, confidence.
        work_size: (height, width) that the network sees.

    Raises:
        UserError: the image cannot be read.
    """
    _, encoded = encode([anchor], work_size=work_size)
    device = next(encode.model.parameters()).device
    empty = torch.zeros(1, 1, *work_size, device=device)
    # The standard deviation is that of two views: there is no curve for fewer.
    found = encode.model.densified(encoded, as_points(KnownDepth(empty, empty)), num_views=2)
    work = KnownDepth(found.depth[0], (found.std / found.depth)[0])
    return finished_map(anchor, work, KeypointDepths.of(empty[0]), config)
