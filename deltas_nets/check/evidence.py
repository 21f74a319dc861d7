"""Matches as evidence for and against cameras."""

from deltas_geom.diagnosis.evidence import Evidence, gather_evidence
from deltas_nets.check.matched import Matched

__all__ = ["evidence_of"]


def evidence_of(matched: Matched) -> Evidence:
    """Pairs of frames and their matches."""
    return gather_evidence(matched.pixels.nan_to_num(), matched.seen)
