"""What a network says of a view set: the depth of its anchor, and every stage that led to it."""

from torch import Tensor

from deltas_geom import Matches, SparseDepth, Triangulation
from deltas_geom.records import Record
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.network.lite.densifier import DenseDepth
from deltas_nets.network.lite.detector import Keypoints
from deltas_nets.network.records import Posterior


class Evidence(Record):
    """What the prediction rests on; training supervises it, notebooks show it.

    Attributes:
        confidence: ``(*B, N)`` probability that a point's depth is right.
        posterior: belief over inverse depth.
        dense: log depth at four scales and its spread.
    """

    confidence: Tensor
    posterior: Posterior
    dense: DenseDepth


class DepthPrediction(Record):
    """Depth of the anchor, and every stage that led to it.

    Attributes:
        depth: ``(*B, 1, H, W)`` metres along z.
        std: ``(*B, 1, H, W)`` its standard deviation, metres, calibrated if the weights are.
        keypoints: N points of the anchor.
        matches: where they are seen in all views.
        points: triangulated, in the world, in the dtype of the poses if that is wider than the
            network's.
        sparse: their depth as an image.
        evidence: posterior, confidence, scales.
    """

    depth: Tensor
    std: Tensor
    keypoints: Keypoints
    matches: Matches
    points: Triangulation
    sparse: SparseDepth
    evidence: Evidence

    def confidence(self, tolerance: float = 0.05) -> Tensor:
        """Probability ``(*B, 1, H, W)`` that the relative error is below ``tolerance``.

        Raises:
            ValueError: the tolerance is not positive.
        """
        return KnownDepth(self.depth, self.std / self.depth).confidence(tolerance)
