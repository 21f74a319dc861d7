"""The whole check of a capture: files and cameras first, then matches, then sensor depth."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch

from deltas_geom.diagnosis.causes import Cause
from deltas_geom.diagnosis.evidence import Evidence, residuals
from deltas_geom.diagnosis.results import Diagnosis
from deltas_geom.diagnosis.trials import level
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.check.depth_camera import unregistered_depth
from deltas_nets.check.evidence import evidence_of
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.frames_apart import views_apart
from deltas_nets.check.kinds_of_cameras import wrong_kinds
from deltas_nets.check.matched import Matched, match_capture
from deltas_nets.check.mending import leaving_out
from deltas_nets.check.quick import quick_findings
from deltas_nets.check.scale import wrong_scale
from deltas_nets.check.sensor import sensors
from deltas_nets.check.time_shift import poses_of_other_frames
from deltas_nets.check.trying import ENOUGH
from deltas_nets.check.whole import diagnosed, of_all_cameras
from deltas_nets.network.deltas import Deltas

__all__ = ["Checked", "Figures", "check_capture", "judge_matches"]

_LEAST_PAIRS = 3
_MOSTLY = 0.6  # of the pairs must fit before depth is held against cameras
OVERRULED = (Fault.K_OF_OTHER_SIZE, Fault.SIDES_SWAPPED)
"""What a principal point only hints at, and matches know: photos may have been cropped."""


class Figures(NamedTuple):
    """What was looked at.

    Attributes:
        frames: of the capture, with a pose.
        looked_at: how many of them were matched.
        pairs: of frames, whose matches count.
        matches: in those pairs.
        residual: px, at about 400 px of width, median over pairs; NaN without any.
        fit: share of the pairs that cameras fit.
        seconds: that all took.
    """

    frames: int
    looked_at: int
    pairs: int
    matches: int
    residual: float
    fit: float
    seconds: float


class Checked(NamedTuple):
    """What is wrong with a capture, worst first, and what was looked at."""

    findings: tuple[Finding, ...]
    figures: Figures

    @property
    def verdict(self) -> str:
        """One line."""
        if not self.findings:
            residual = f": matches fit to {self.figures.residual:.2g} px"
            return "no finding" + (residual if self.figures.pairs else "")
        first = self.findings[0]
        more = f" (and {len(self.findings) - 1} more)" if len(self.findings) > 1 else ""
        return f"{first.cause.value}{more}"

    def mended(self, capture: Capture) -> Capture:
        """The capture with everything mended that can be."""
        for finding in self.findings:
            if finding.mend is not None:
                capture = finding.mend(capture)
        return capture

    def in_json(self) -> dict[str, Any]:
        """For a file."""
        return {
            "verdict": self.verdict,
            "findings": [finding.in_json() for finding in self.findings],
            "figures": self.figures._asdict(),
        }


def check_capture(
    capture: Capture, network: Deltas, *, report: Callable[[str], None] = lambda _: None
) -> Checked:
    """Find out what is wrong with a capture.

    Args:
        capture: as it was read.
        network: whose descriptors match frames; `load_model("deltas-small")`.
        report: called while frames are matched.
    """
    start = time.monotonic()
    found = quick_findings(capture)
    hopeless = {Fault.NONSENSE_CALIBRATION, Fault.NONSENSE_LENS, Fault.NO_BASELINE}
    if any(finding.cause in hopeless for finding in found):
        figures = Figures(len(capture.frames), 0, 0, 0, float("nan"), 0.0, 0.0)
        return _checked(found, figures, start)
    matched = match_capture(capture, network, report=report)
    more, figures = judge_matches(capture, matched)
    if figures.pairs:
        found = [one for one in found if one.cause not in OVERRULED]
        known = {one.cause for one in more}
        found = [one for one in found if one.cause not in known]
    return _checked([*found, *more], figures, start)


def _checked(findings: list[Finding], figures: Figures, start: float) -> Checked:
    ordered = sorted(findings, key=lambda finding: finding.severity != "error")
    return Checked(tuple(ordered), figures._replace(seconds=time.monotonic() - start))


def judge_matches(capture: Capture, matched: Matched) -> tuple[list[Finding], Figures]:
    """Findings from what was matched; the network is not needed any more."""
    total, looked = len(capture.frames), len(matched.positions)
    evidence = evidence_of(matched)
    pairs = len(evidence.pairs)
    if not pairs:
        figures = Figures(total, looked, 0, 0, float("nan"), 0.0, 0.0)
        what = f"of {looked} frames no two share matches enough"
        cure = "take pictures that overlap, in better light; plain walls and blur have no matches"
        return [Finding(Fault.FEW_MATCHES, what, (), cure, "warning")], figures
    given = residuals(evidence, *matched.views(capture.frames))
    fit = float((given <= ENOUGH).double().mean())
    figures = Figures(
        total, looked, pairs, int(evidence.counts.sum()), float(given.median()), fit, 0.0
    )
    found = _explained(capture, matched, evidence, given)
    return [*found, *_by_sensor(_same_frames(capture, found), matched, evidence)], figures


def _same_frames(capture: Capture, findings: list[Finding]) -> Capture:
    """The capture mended, where that leaves its frames where they are."""
    for finding in findings:
        mended = capture if finding.mend is None else finding.mend(capture)
        capture = mended if len(mended.frames) == len(capture.frames) else capture
    return capture


def _by_sensor(capture: Capture, matched: Matched, evidence: Evidence) -> list[Finding]:
    """Findings from sensor depth, on the pairs of frames that cameras fit."""
    fit = residuals(evidence, *matched.views(capture.frames)) <= ENOUGH
    if float(fit.double().mean()) < _MOSTLY:
        return []
    evidence = evidence.of(fit)
    pairs = [
        (matched.positions[one], matched.positions[other]) for one, other in evidence.pairs.tolist()
    ]
    if len(pairs) < _LEAST_PAIRS:
        return []
    known = sensors(capture.frames, sorted({position for pair in pairs for position in pair}))
    wrong = wrong_scale(capture, matched, evidence, known)
    if wrong and wrong[0].mend is not None:
        capture = wrong[0].mend(capture)
        known = sensors(capture.frames, list(known))
    return [*wrong, *unregistered_depth(capture, known, pairs)]


def _explained(
    capture: Capture, matched: Matched, evidence: Evidence, given: torch.Tensor
) -> list[Finding]:
    diagnosis = diagnosed(capture, matched)
    suspects = [
        suspect
        for suspect in (
            of_all_cameras(diagnosis),
            poses_of_other_frames(capture, matched, evidence),
            *wrong_kinds(capture, matched, evidence),
        )
        if suspect is not None
    ]
    if diagnosis.cause is Cause.NO_BASELINE:
        return [_no_baseline(diagnosis)]
    if suspects:
        best = min(suspects, key=lambda suspect: suspect.tried.after)
        # Of those that are about as good, the simplest: they come in that order.
        return [
            next(s for s in suspects if s.tried.after <= 1.25 * best.tried.after + 0.05).finding
        ]
    apart = views_apart(evidence, given, len(matched.positions))
    if apart:
        return [_apart(capture, matched, evidence, given, apart)]
    if level(given) > ENOUGH:
        return [_unexplained(diagnosis, matched, capture)]
    return []


def _no_baseline(diagnosis: Diagnosis) -> Finding:
    cure = "take pictures from other places (a few centimetres for each metre of distance)"
    return Finding(Fault.NO_BASELINE, diagnosis.sentence, (), cure, "error")


def _apart(
    capture: Capture,
    matched: Matched,
    evidence: Evidence,
    given: torch.Tensor,
    apart: list[int],
) -> Finding:
    ids = tuple(capture.frames.id_at(matched.positions[view]) for view in apart)
    off = evidence.with_camera(*apart)
    what = (
        f"{len(ids)} of {len(matched.positions)} frames looked at ({ids_in_words(ids)}): their "
        f"matches are {level(given[off]):.3g} px off, those of the others {level(given[~off]):.2g}"
    )
    cure = f"leave out {ids_in_words(ids, 40)}, or track them again"
    return Finding(Fault.FRAMES_DISAGREE, what, ids, cure, "error", leaving_out(ids))


def _unexplained(diagnosis: Diagnosis, matched: Matched, capture: Capture) -> Finding:
    order = diagnosis.camera_residuals.nan_to_num(-1.0).argsort(descending=True)[:3].tolist()
    worst = ", ".join(
        f"frame {capture.frames.id_at(matched.positions[view])} by "
        f"{float(diagnosis.camera_residuals[view]):.3g}"
        for view in order
    )
    what = f"matches are {diagnosis.residual_as_given:.3g} px off ({worst} px)"
    cure = "see where poses and intrinsics come from; a lens that bends lines has to be stated"
    return Finding(Fault.UNEXPLAINED, what, (), cure, "error")
