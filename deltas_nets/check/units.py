"""Poses that are hardly in metres, where nothing measures in which unit they are."""

from typing import Literal

from deltas_nets.check.finding import Fault, Finding

__all__ = ["hardly_metres"]


def hardly_metres(
    what: str, distance: float, *, severity: Literal["error", "warning"] = "error"
) -> Finding:
    """A finding without a mend: which unit it is, only whoever made the poses knows.

    Args:
        what: is that far away, in words.
        distance: in the unit of the poses.
        severity: a warning where there are such scenes.
    """
    evidence = f"{what} {distance:.3g} m (median)"
    cure = (
        f"multiply the translations of poses by 0.01 if they are in centimetres "
        f"({distance / 100:.3g} m then), by 0.001 if in millimetres ({distance / 1000:.3g} m)"
    )
    if severity == "warning":
        cure += "; if the scene is that large, give deltas depth its --depth-range"
    return Finding(Fault.NOT_METRES, evidence, (), cure, severity)
