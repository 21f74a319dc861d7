"""How images, key points and cameras of several anchors share a batch."""

from torch import Tensor

from deltas_geom.checks import ShapeError


def batch_and_views(
    descriptors: Tensor, keypoints: Tensor, intrinsics: Tensor, cam_from_anchor: Tensor
) -> tuple[int, int]:
    """B anchors and V sources of each, if all shapes agree on them.

    Args:
        descriptors: ``((1 + V) * B, D, h, w)``, first the anchors, then all first sources.
        keypoints: ``(B, N, 2)``.
        intrinsics: ``(B, 3, 3)``.
        cam_from_anchor: ``(B, V, 4, 4)``.

    Raises:
        ShapeError: they do not.
    """
    if keypoints.ndim != 3 or keypoints.shape[-1] != 2:
        raise ShapeError(f"keypoints must have shape (B, N, 2), got {tuple(keypoints.shape)}")
    batch = len(keypoints)
    if intrinsics.shape != (batch, 3, 3):
        raise ShapeError(
            f"intrinsics must have shape ({batch}, 3, 3), got {tuple(intrinsics.shape)}"
        )
    if cam_from_anchor.ndim != 4 or cam_from_anchor.shape[::2] != (batch, 4):
        raise ShapeError(
            f"cam_from_anchor must have shape ({batch}, V, 4, 4), got "
            f"{tuple(cam_from_anchor.shape)}"
        )
    views = cam_from_anchor.shape[1]
    if descriptors.ndim != 4 or len(descriptors) != (1 + views) * batch:
        raise ShapeError(
            f"descriptors must have shape ({(1 + views) * batch}, D, h, w) for {batch} anchors "
            f"with {views} sources each, got {tuple(descriptors.shape)}"
        )
    return batch, views
