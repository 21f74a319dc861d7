"""Intrinsics that were nonsense, guessed and then found by matches."""

from deltas_nets.captures.capture import Capture
from deltas_nets.check.finding import Fault, Finding, Mend
from deltas_nets.check.intrinsics import in_a_line

__all__ = ["improved_guess"]

_OF_K = (Fault.FOCAL_LENGTH, Fault.K_OF_OTHER_SIZE, Fault.K_OF_SOME_FRAMES)
_UNCONFIRMED = (Fault.UNEXPLAINED, Fault.FEW_MATCHES)
"""What leaves a guess a guess: --mend would write it as if it were known."""


def improved_guess(
    guess: Finding, found: list[Finding], guessed: Capture
) -> tuple[Finding, list[Finding]]:
    """A finding of nonsense, with the cure that matches tell, and the others that are left.

    Args:
        guess: whose mend is a guess; without it where matches do not confirm it.
        found: what matches say of the capture with that mend.
        guessed: that capture.
    """
    if any(one.cause in _UNCONFIRMED for one in found):
        return guess._replace(mend=None), found
    of_K = next((one for one in found if one.cause in _OF_K), None)
    rest = [one for one in found if one is not of_K]
    if of_K is None or of_K.mend is None or guess.mend is None:
        if not any(one.severity == "error" for one in found) and guess.mend is not None:
            K = in_a_line(guessed.frames.K[0], guessed.form.centre)
            guess = guess._replace(cure=f"{guess.cure}; matches fit {K}")
        return guess, rest
    right = of_K.mend(guessed).frames
    position = list(right).index(of_K.frames[0]) if of_K.frames else 0
    K = in_a_line(right.K[position], guessed.form.centre)
    evidence = f"{guess.evidence}; matches fit {K}"
    return guess._replace(
        evidence=evidence, cure=f"write K as {K}", mend=_both(guess.mend, of_K.mend)
    ), rest


def _both(first: Mend, second: Mend) -> Mend:
    return lambda capture: second(first(capture))
