"""One line on whether maps can be trusted, from what the summary records of each."""

from collections.abc import Mapping, Sequence
from statistics import mean, median
from typing import Any, NamedTuple

from deltas_nets.terminal import counted

__all__ = ["Verdict", "verdict"]

USUAL_CONFIDENCE = 0.5
"""The median over a capture of its maps' mean confidence: 0.50 to 0.62 of indoor captures with
right poses, 0.12 to 0.33 with poses inverted or in OpenGL's axes."""
LOW_CONFIDENCE = 0.4
USUAL_SHARE = 0.5  # of keypoints that are triangulated
USUAL_FACTOR = 1.5
"""Of measured depth beside what is triangulated, either way: medians over indoor captures are 0.97
to 1.01, those of single maps 0.73 to 1.24."""


class Verdict(NamedTuple):
    """What is printed at the end, and stands in the summary.

    Attributes:
        line: a sentence.
        doubtful: something is likely to be wrong.
    """

    line: str
    doubtful: bool


def verdict(records: Sequence[Mapping[str, Any]], *, short: int = 0) -> Verdict:
    """What maps are like as a whole.

    Args:
        records: of frames, as `deltas_nets.predict.passes` writes them.
        short: view sets with fewer views than asked.

    Example:
        >>> good = {"confidence": 0.55, "valid_points": 600, "keypoints": 800}
        >>> verdict([good, good]).line
        'mean confidence 0.55 (usual: 0.5 or more), 75 % of points triangulated'
    """
    # What the network says of itself: maps that agree are surer, also where all of them are wrong.
    sure = [
        record.get("network_confidence", record["confidence"])
        for record in records
        if "confidence" in record
    ]
    shares = [
        record["valid_points"] / record["keypoints"]
        for record in records
        if record.get("keypoints", 0) > 0
    ]
    words, low = [], False
    if sure:
        low = median(sure) < LOW_CONFIDENCE
        words.append(f"mean confidence {mean(sure):.2f} (usual: {USUAL_CONFIDENCE} or more)")
    if shares:
        low = low or median(shares) < 0.5 * USUAL_SHARE
        words.append(f"{100 * mean(shares):.0f} % of points triangulated")
    if short:
        words.append(f"{counted(short, 'view set')} short of views")
    if low:
        words.append(
            "which is low: views are too near to each other or too far apart, surfaces too plain, "
            "or poses or intrinsics wrong; deltas check tells which"
        )
    factors = [record["measured_factor"] for record in records if "measured_factor" in record]
    apart = bool(factors) and not 1 / USUAL_FACTOR < median(factors) < USUAL_FACTOR
    if apart:
        words.append(
            f"measured depth is {median(factors):.3g} times as far as what matches triangulate to: "
            "its unit is wrong, or that of the poses; deltas check tells which"
        )
    return Verdict(", ".join(words) or "nothing to judge by", low or apart)
