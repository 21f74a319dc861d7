"""The unit that a file of ours states."""

from deltas_nets.captures.readers.json_file import Fields
from deltas_nets.errors import UserError

__all__ = ["is_metric"]

METRES = ("metre", "metres", "meter", "meters", "m")
OTHERS = {
    "millimetre": 0.001, "millimeter": 0.001, "mm": 0.001, "centimetre": 0.01, "centimeter": 0.01,
    "cm": 0.01, "decimetre": 0.1, "decimeter": 0.1, "dm": 0.1, "kilometre": 1000.0,
    "kilometer": 1000.0, "km": 1000.0, "inch": 0.0254, "inche": 0.0254, "in": 0.0254,
    "foot": 0.3048, "feet": 0.3048, "ft": 0.3048,
}  # fmt: skip
"""Metres of units that have a length, without an s. They are refused: nobody would know whether
depth files are in metres or in them."""


def is_metric(root: Fields) -> bool:
    """Whether the stated unit is the metre, rather than one that nobody knows the length of.

    Raises:
        UserError: no unit is stated, or one whose length is known and is not a metre.
    """
    if "units" not in root:
        unknown = _as_said(root, "unknown")
        remedy = f"say {_as_said(root, 'metres')}, or {unknown} where the scale is not known"
        raise UserError("the file does not state its units", root.path, remedy)
    units = root.text("units").strip()
    length = OTHERS.get(units.lower().removesuffix("s"))
    if length is not None:
        metres, unknown = _as_said(root, "metres"), _as_said(root, "unknown")
        remedy = f"multiply translations by {length:g} and say {metres}, or say {unknown} "
        remedy += f"and add --scale {length:g}"
        raise UserError(f"the file's units are {units}, not metres", root.path, remedy)
    return units.lower() in METRES


def _as_said(root: Fields, units: str) -> str:
    """How the file would state a unit."""
    return f"# units: {units}" if root.path.suffix == ".csv" else f'"units": "{units}"'
