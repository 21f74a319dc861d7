"""Why an item of a batch has no answer: failure is data, not an exception."""

from enum import IntEnum


class Status(IntEnum):
    """Outcome of one point or one segment; stored as int8 tensors.

    OK: valid. TOO_FEW_VIEWS: fewer than two views count, or agree. NO_PARALLAX: depth cannot be
    seen from where the cameras stand. AT_INFINITY: the rays are parallel. BEHIND_CAMERA: they meet
    behind a used camera. NOT_FINITE_INPUT: something used is NaN or infinite. EMPTY: nothing of the
    depth range is visible (segments). OUT_OF_RANGE: the depth is not within the range asked for.
    RESIDUAL_TOO_LARGE: the views disagree by more than was asked for.

    Example:
        >>> print(Status.BEHIND_CAMERA.explanation)
        the rays meet behind a used camera: a match is wrong, or a pose is inverted
    """

    OK = 0
    TOO_FEW_VIEWS = 1
    NO_PARALLAX = 2
    AT_INFINITY = 3
    BEHIND_CAMERA = 4
    NOT_FINITE_INPUT = 5
    EMPTY = 6
    OUT_OF_RANGE = 7
    RESIDUAL_TOO_LARGE = 8

    @property
    def explanation(self) -> str:
        """One sentence: the cause and, where there is one, the cure."""
        return _EXPLANATIONS[self]


_EXPLANATIONS = {
    Status.OK: "the result is valid",
    Status.TOO_FEW_VIEWS: (
        "fewer than two views have a true mask and a weight that counts, or agree: add matches for "
        "this point"
    ),
    Status.NO_PARALLAX: (
        "the used cameras are in line with the point, so depth cannot be seen: add a view from "
        "elsewhere; in float32 also if the world's origin is far away: use float64"
    ),
    Status.AT_INFINITY: (
        "the rays are parallel within rounding: treat the point as a direction, or widen the "
        "baseline"
    ),
    Status.BEHIND_CAMERA: (
        "the rays meet behind a used camera: a match is wrong, or a pose is inverted"
    ),
    Status.NOT_FINITE_INPUT: (
        "a used pixel, weight or camera is NaN or infinite: mask the view for this point"
    ),
    Status.EMPTY: (
        "no depth of the range is visible in this source: widen the range or choose another view"
    ),
    Status.OUT_OF_RANGE: (
        "the rays meet nearer or farther than the depth range, or behind the view whose range it "
        "is: a match is wrong, or widen the range"
    ),
    Status.RESIDUAL_TOO_LARGE: (
        "the views disagree about the point by more than the residual allowed: a match or a camera "
        "is wrong; errors tells which view, diagnose tells why"
    ),
}
