"""A capture that cannot even be read: the reader's error, as a finding."""

from pathlib import Path

from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.verdict import Checked, Figures
from deltas_nets.errors import UserError

__all__ = ["checked_refusal"]


def checked_refusal(path: Path, error: UserError) -> Checked:
    """The error of reading a capture, as what was found.

    Raises:
        UserError: there is nothing at the path that could be checked.
    """
    if not path.exists():
        raise error
    finding = Finding(Fault.REFUSED, f"{error.what}, {error.where}", (), error.remedy, "error")
    return Checked((finding,), Figures(0, 0, 0, 0, float("nan"), 0.0, 0.0))
