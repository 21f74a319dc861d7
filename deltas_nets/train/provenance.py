"""Where the weights of a run come from, as its checkpoint keeps it and the weights say it."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from deltas_nets.config import TrainConfig, without_paths
from deltas_nets.distill.teachers import LICENCES
from deltas_nets.errors import UserError
from deltas_nets.weights_file import with_last

OURS = "Apache-2.0"
TEACHER = "--teacher-weights"
_OF_POINTS = ("detector_teacher", "detector_teacher_licence", "detector_data")
"""What weights still owe to whoever taught their detector, however much they learn afterwards."""


class Provenance(NamedTuple):
    """Where the weights of a run come from.

    Attributes:
        origin: what they started from, with its licence.
        before: the record of the weights that they started from; None if there were none.
        began: what the run began with, by option: SHA-256 of files, and the step.
    """

    origin: str
    before: Mapping[str, str] | None = None
    began: Mapping[str, str] | None = None


def record_of(config: TrainConfig, provenance: Provenance) -> dict[str, str]:
    """Data, origin, licence and teacher of weights, those of what they started from among them."""
    data, licence = _data_and_licence(without_paths(config))
    kept: dict[str, str] = {}
    if provenance.before is not None:
        before = provenance.before
        kept = {name: value for name, value in before.items() if _still_holds(name, config)}
        data = with_last(before.get("data", "unknown data"), data)
        licence = _joined(before.get("licence", "unknown licence"), licence)
    record = kept | {"data": data, "origin": provenance.origin, "licence": licence}
    if config.teacher is not None:
        licences = kept.get("detector_teacher_licence", "")
        record |= {
            "detector_teacher": config.teacher,
            "detector_teacher_licence": with_last(licences, LICENCES[config.teacher]),
        }
    return record


def check_began(
    began: Mapping[str, str] | None, given: Mapping[str, str | None], folder: Path
) -> None:
    """Whether a run goes on with the files and the step that it began with, as far as given.

    Args:
        began: by option; None of a run of before they were kept.
        given: the same of what it is to go on with; None where that is no file.
        folder: of the run.

    Raises:
        UserError: names the option that says something else.
    """
    for option, value in given.items():
        if began is not None and began.get(option) != value:
            wanted = "give the file of then" if option == TEACHER else "leave that option out"
            what = f"the run in {folder} did not begin with this"
            raise UserError(what, option, f"{wanted}, or start a new run in another folder")


def _still_holds(name: str, config: TrainConfig) -> bool:
    """Whether an entry of the earlier record is true of weights that learned on."""
    if name in _OF_POINTS:
        return True
    # How a detector was distilled describes it as long as nothing else teaches it.
    return name.startswith("detector_") and "detector" in config.freeze


def _data_and_licence(config: TrainConfig) -> tuple[str, str]:
    """What a run trains on, and what that leaves of our licence."""
    data = config.data
    if data.source == "rooms":
        return f"procedural rooms {data.seed}..{data.seed + data.num_rooms}", OURS
    terms = "trained on ScanNet, whose terms of use apply"
    return f"ScanNet, scenes of {data.scannet.split}", terms


def _joined(before: str, licence: str) -> str:
    """Terms of what was learned before go on; ours is that of weights without any others."""
    terms = [part for part in with_last(before, licence).split("; ") if part != OURS]
    return "; ".join(terms) or OURS
