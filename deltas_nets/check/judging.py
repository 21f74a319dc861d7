"""What matches and sensor depth say of cameras: one cause that explains most, or none."""

from typing import NamedTuple

import torch

from deltas_geom.diagnosis.causes import Cause
from deltas_geom.diagnosis.evidence import Evidence, residuals
from deltas_geom.diagnosis.results import Diagnosis
from deltas_geom.diagnosis.trials import level
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.check.axes import other_axes
from deltas_nets.check.bent import LENSES, wrong_lenses_of_matches
from deltas_nets.check.depth_camera import unregistered_depth
from deltas_nets.check.evidence import evidence_of
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.frames_apart import MOSTLY, views_apart
from deltas_nets.check.kinds_of_cameras import wrong_kinds
from deltas_nets.check.matched import Matched
from deltas_nets.check.mending import leaving_out
from deltas_nets.check.quaternions import other_quaternions
from deltas_nets.check.scale import wrong_scale
from deltas_nets.check.sensor import sensors
from deltas_nets.check.shaky import shaky_poses
from deltas_nets.check.time_shift import poses_of_other_frames
from deltas_nets.check.trying import ENOUGH, Case
from deltas_nets.check.turned import turned_images, turned_images_of_right_K
from deltas_nets.check.whole import diagnosed, of_all_cameras

__all__ = ["Figures", "judge_matches"]

_LEAST_PAIRS = 3
_MOSTLY = 0.6  # of the pairs must fit before depth is held against cameras
_ENOUGH_PAIRS = 6
"""Of fewer, which cameras fit, what is left of residuals is explained by almost anything."""


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
    found = _explained(Case(capture, matched, evidence, given))
    if found and found[0].cause in LENSES:
        return found, figures
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


def _explained(case: Case) -> list[Finding]:
    capture, matched, evidence, given = case
    diagnosis = diagnosed(capture, matched)
    if diagnosis.cause is Cause.NO_BASELINE:
        return [_no_baseline(diagnosis)]
    if level(given) <= ENOUGH and len(evidence.pairs) < _ENOUGH_PAIRS:
        return []
    suspects = [
        suspect
        for suspect in (
            *of_all_cameras(case),
            poses_of_other_frames(capture, matched, evidence),
            *wrong_kinds(capture, matched, evidence),
            *wrong_lenses_of_matches(capture, matched, evidence),
            *other_quaternions(case),
        )
        if suspect is not None
    ]
    if not suspects and level(given) > ENOUGH:
        axes = other_axes(case)
        others = [] if axes is None else [axes]
        suspects = [*turned_images_of_right_K(case), *others, *turned_images(case)]
    if suspects:
        best = min(suspects, key=lambda suspect: suspect.tried.after)
        # Of those that are about as good, the simplest: they come in that order.
        return [
            next(s for s in suspects if s.tried.after <= 1.25 * best.tried.after + 0.05).finding
        ]
    strict = residuals(evidence, *matched.views(capture.frames), share=MOSTLY)
    apart = views_apart(evidence, strict, len(matched.positions))
    if apart:
        return [_apart(capture, matched, evidence, strict, apart)]
    if level(given) > ENOUGH:
        return [_unexplained(diagnosis, matched, capture)]
    shaky = shaky_poses(case)
    return [] if shaky is None else [shaky]


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
