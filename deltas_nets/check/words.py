"""The report of a check, for people."""

from collections.abc import Iterator
from pathlib import Path
from shlex import quote
from textwrap import wrap

from deltas_nets.captures.ids import ids_in_words
from deltas_nets.check.verdict import Checked

__all__ = ["mended_in_words", "report_lines"]

_WIDTH = 96


def report_lines(checked: Checked, capture: Path, intrinsics: str | None = None) -> Iterator[str]:
    """Lines to print: what is wrong, how that is known, what to do, and what was looked at.

    Cures and commands are a line each, however long, as what is copied from two lines is two
    commands to a shell.

    Args:
        checked: what was found.
        capture: its path, as it was given.
        intrinsics: those of ``--intrinsics``, without which some captures cannot be opened.
    """
    for number, finding in enumerate(checked.findings, start=1):
        yield f"{number}. {finding.severity}: {finding.cause.value}"
        yield from _part("evidence", finding.evidence)
        if finding.frames:
            yield from _part("frames", ids_in_words(finding.frames, 20))
        yield _line("cure", finding.cure)
        if finding.mend is not None:
            yield _line("or", mending_command(capture, intrinsics))
        yield ""
    yield f"verdict: {checked.verdict}"
    yield figures_in_words(checked)


def mending_command(capture: Path, intrinsics: str | None) -> str:
    """The command that mends what was found, as a shell takes it."""
    stated = "" if intrinsics is None else f" --intrinsics {quote(intrinsics)}"
    return f"deltas check {quote(str(capture))}{stated} --mend OUT"


def figures_in_words(checked: Checked) -> str:
    """What was looked at, in a line."""
    found = checked.figures
    if not found.frames:
        return "no frame was looked at"
    frames = f"{found.looked_at} of {found.frames} frames looked at"
    if not found.pairs:
        return f"{frames}, {found.seconds:.1f} s"
    return (
        f"{frames}: {found.matches} matches in {found.pairs} pairs, median residual "
        f"{found.residual:.2g} px, {100 * found.fit:.0f} % of the pairs fit, {found.seconds:.1f} s"
    )


def mended_in_words(checked: Checked, out: Path) -> str:
    """What became of --mend, in a line."""
    if not checked.findings:
        return f"nothing to mend: {out} is not written"
    if not checked.mendable:
        return f"nothing of it can be mended here: {out} is not written"
    left = len(checked.findings) - len(checked.mendable)
    return f"mended: {out}" + (
        f"; {left} of {len(checked.findings)} findings are left" * (left > 0)
    )


def _line(name: str, text: str) -> str:
    return f"   {name + ':':10}{text}"


def _part(name: str, text: str) -> list[str]:
    return wrap(
        text,
        _WIDTH,
        initial_indent=f"   {name + ':':10}",
        subsequent_indent=" " * 13,
        break_long_words=False,
        break_on_hyphens=False,
    )
