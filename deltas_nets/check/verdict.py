"""The whole check of a capture: files and cameras first, then images, matches, sensor depth."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from deltas_geom.checks import check_kind
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.check.depth_files import unreadable_depth
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.guesses import improved_guess
from deltas_nets.check.image_sizes import wrong_sizes
from deltas_nets.check.images import look_at_images
from deltas_nets.check.judging import Figures, judge_matches
from deltas_nets.check.matched import match_capture
from deltas_nets.check.mending import leaving_out
from deltas_nets.check.quick import quick_findings
from deltas_nets.check.scan import scan_frames
from deltas_nets.check.unmatched import unmatched_frames
from deltas_nets.network.deltas import Deltas

__all__ = ["Checked", "check_capture"]

OVERRULED = (Fault.K_OF_OTHER_SIZE, Fault.SIDES_SWAPPED)
"""What a principal point only hints at, and matches know: photos may have been cropped."""
GUESSED = (Fault.NONSENSE_CALIBRATION, Fault.NONSENSE_LENS)
"""What is mended by a guess, which matches then improve."""


class Checked(NamedTuple):
    """What is wrong with a capture, worst first, and what was looked at."""

    findings: tuple[Finding, ...]
    figures: Figures

    @classmethod
    def of_refused(cls, findings: Sequence[Finding]) -> "Checked":
        """Of a capture that could not be read: nothing was looked at."""
        return cls(tuple(findings), Figures(0, 0, 0, 0, float("nan"), 0.0, 0.0))

    @property
    def verdict(self) -> str:
        """One line."""
        looked = f"{self.figures.looked_at} of {self.figures.frames} frames"
        if not self.findings:
            fit = f": matches of {looked} fit to {self.figures.residual:.2g} px"
            return "no finding" + (fit if self.figures.pairs else "")
        first = self.findings[0]
        more = f", and {len(self.findings) - 1} more" if len(self.findings) > 1 else ""
        seen = f" ({looked} looked at)" if self.figures.looked_at else ""
        return f"{first.cause.value}{more}{seen}"

    @property
    def mendable(self) -> tuple[Finding, ...]:
        """Those that can be mended in memory."""
        return tuple(finding for finding in self.findings if finding.mend is not None)

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
    capture: Capture,
    network: Deltas,
    *,
    known: Sequence[Finding] = (),
    threads: int = 1,
    report: Callable[[str], None] = lambda _: None,
) -> Checked:
    """Find out what is wrong with a capture.

    Args:
        capture: as it was read.
        network: whose descriptors match frames; `load_model("deltas-small")`.
        known: what was found when it was read, and mended by a guess.
        threads: that look at frames, each computing alone: frames are small.
        report: called while frames are matched.
    """
    check_kind("capture", capture, Capture, "open_capture(PATH)")
    check_kind("network", network, Deltas, "load_model(NAME)")
    start = time.monotonic()
    sizes = wrong_sizes(capture)
    readable = sizes[0].mend(capture) if sizes and sizes[0].mend is not None else capture
    certain = [*known, *sizes]
    found = [*quick_findings(readable), *look_at_images(readable), *unreadable_depth(readable)]
    if any(_leaves_nothing(finding) for finding in found):
        figures = Figures(len(capture.frames), 0, 0, 0, float("nan"), 0.0, 0.0)
        return _checked([*certain, *found], figures, start)
    guesses = [finding for finding in found if finding.cause in GUESSED]
    for guess in guesses:
        readable = readable if guess.mend is None else guess.mend(readable)
    matched = match_capture(readable, network, threads=threads, report=report)
    more, figures = judge_matches(readable, matched)
    found += unmatched_frames(readable, matched)
    if figures.pairs:
        told = {*OVERRULED, *(one.cause for one in more)}
        if Fault.POSES_OF_OTHER_FRAMES in told:
            told.add(Fault.FROZEN_POSES)  # those that filled up a list that was too short
        found = [one for one in found if one.cause not in told]
    if figures.looked_at < len(readable.frames):
        for place, one in enumerate(more):
            if one.cause is Fault.FRAMES_DISAGREE:
                more[place], looked = _all_apart(readable, network, one, threads)
                figures = figures._replace(looked_at=max(figures.looked_at, looked))
    told_before = [*certain, *found]
    for guess in [*known, *guesses][-1:]:
        improved, more = improved_guess(guess, more, readable)
        told_before = [improved if one is guess else one for one in told_before]
    return _checked([*told_before, *more], figures, start)


def _leaves_nothing(finding: Finding) -> bool:
    """Whether matches cannot tell more: cameras stand still, or no image can be read."""
    no_image = finding.cause is Fault.IMAGES_UNREADABLE and not finding.frames
    return no_image or finding.cause is Fault.NO_BASELINE


def _checked(findings: list[Finding], figures: Figures, start: float) -> Checked:
    # The first of each cause: a check that comes later sees the same from farther away.
    first = {finding.cause: finding for finding in reversed(findings)}
    ordered = sorted(reversed(first.values()), key=lambda finding: finding.severity != "error")
    return Checked(tuple(ordered), figures._replace(seconds=time.monotonic() - start))


def _all_apart(
    capture: Capture, network: Deltas, found: Finding, threads: int
) -> tuple[Finding, int]:
    """The finding with all frames that disagree, and how many were looked at."""
    apart, looked = scan_frames(capture, network, threads=threads)
    ids = set(found.frames) | {capture.frames.id_at(position) for position in apart}
    if len(ids) == len(found.frames):
        return found, looked
    named = tuple(id for id in capture.frames if id in ids)
    what = f"{found.evidence}; of {looked} frames looked at closer {len(named)} disagree"
    cure = f"leave out {ids_in_words(named, 40)}, or track them again"
    return found._replace(evidence=what, frames=named, cure=cure, mend=leaving_out(named)), looked
