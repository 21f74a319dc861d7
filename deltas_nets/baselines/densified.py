"""Points from elsewhere through the densifier of `deltas-small`: what its own points are worth."""

import torch

from deltas_geom import rasterize_depth
from deltas_geom.cameras.pixels import resize_pixels
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.predict.depth_map import DepthMap, KeypointDepths, Wanted, finished_map
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.predict.ours import work_size_of
from deltas_nets.weights_file import weights_record


def densifier_record(name: str) -> dict[str, str]:
    """What identifies a baseline that rests on the densifier of `deltas-small`.

    Args:
        name: as `--weights` takes it. The fingerprint is under another name than in records of
            networks: one file makes several baselines.
    """
    of_network = weights_record("deltas-small")
    origin = "the densifier of deltas-small"
    return {"name": name, "origin": origin, "densifier_sha256": of_network["sha256"]}


@torch.inference_mode()
def densified(encode: EncodedFrames, wanted: Wanted, points: KeypointDepths) -> DepthMap:
    """The map of the anchor that rests on points alone, each of full weight.

    Args:
        encode: of a trained network.
        wanted: the anchor and its sources, which are not looked at.
        points: any number of them, at any size.

    Raises:
        UserError: an image cannot be read.
    """
    anchor, config = wanted.anchor, wanted.config
    work_size = work_size_of(anchor, config)
    _, encoded = encode([anchor], work_size=work_size)
    device = next(encode.model.parameters()).device
    pixels = resize_pixels(points.pixels, old_size=points.image_size, new_size=work_size)
    sparse = rasterize_depth(
        pixels[None].to(device),
        points.depth[None].to(device),
        image_size=work_size,
        mask=points.depth[None].to(device) > 0,
        reduce="mean",
    )
    found = encode.model.densified(encoded, sparse, num_views=len(wanted.frames))
    work = KnownDepth(found.depth[0], (found.std / found.depth)[0])
    return finished_map(anchor, work, points, config)._replace(confidence=None, log_std=None)
