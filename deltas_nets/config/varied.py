"""What the paper's supplement varies of a network that is trained: seven numbers at inference.

None is as the network has it. Which network has which of them is said by the networks
(:meth:`deltas_nets.predict.predictor.Predictor.varied`); what one lacks is refused by name.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import tyro

from deltas_nets.config.checks import check_at_least, check_share
from deltas_nets.config.network import NetworkConfig
from deltas_nets.errors import UserError

__all__ = ["NetworkSettings", "varied_config"]

FEWEST_POINTS = 8
FEWEST_SAMPLES = 8

_Whole = Annotated[int | None, tyro.conf.arg(metavar="N")]
_Pixels = Annotated[float | None, tyro.conf.arg(metavar="PIXELS")]


@dataclass(frozen=True)
class NetworkSettings:
    """Numbers of a trained network that the supplement varies; None is the network's own.

    Source: the paper's supplement, tables of the number of points, the ratio, the radius of
    suppression, the threshold, the length of the sampled descriptors and the offsets.

    Example:
        >>> NetworkSettings(num_points=0, offset=2).given()
        {'num_points': 0, 'offset': 2}
    """

    num_points: _Whole = None
    """Points of a map; 0 is none: the network sees a single image (the paper: 512)."""
    detected_share: Annotated[float | None, tyro.conf.arg(metavar="SHARE")] = None
    """At most this share of the points is detected, the others are spread (the paper: 0.5)."""
    nms_radius: _Whole = None
    """Detected points are at least this far apart, pixels of the work size (the paper: 9)."""
    threshold: Annotated[float | None, tyro.conf.arg(metavar="PROBABILITY")] = None
    """Weakest detection that is kept (the paper: 0.0005)."""
    num_samples: _Whole = None
    """Samples along a segment (the paper: 100); of deltas-small, bins of inverse depth."""
    offset: _Pixels = None
    """Lines at this distance on either side of the epipolar line are searched too, pixels (the
    paper: 1); of the paper's networks alone."""

    def __post_init__(self) -> None:
        given = self.given()
        check_at_least(0, self, *given.keys() & {"nms_radius", "offset"})
        check_share(self, *given.keys() & {"threshold"})
        if self.num_points is not None and 0 != self.num_points < FEWEST_POINTS:
            raise ValueError(
                f"num_points must be 0 or at least {FEWEST_POINTS}, got {self.num_points}"
            )
        if self.num_samples is not None:
            check_at_least(FEWEST_SAMPLES, self, "num_samples")
        if self.detected_share is not None and not 0 <= self.detected_share <= 1:
            raise ValueError(f"detected_share must be within [0, 1], got {self.detected_share}")

    def given(self) -> dict[str, Any]:
        """The settings that are not the network's own."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    def check_known(self, network: str, known: Iterable[str] = ()) -> None:
        """Whether a network has what is given.

        Args:
            network: what it is called in the refusal.
            known: names of the settings that it has.

        Raises:
            UserError: it lacks one; the text names it.
        """
        unknown = [name for name in self.given() if name not in set(known)]
        if unknown:
            flags = ", ".join("--" + name.replace("_", "-") for name in unknown)
            raise UserError(f"{network} has no such setting", flags, "leave it out")


def varied_config(config: NetworkConfig, settings: NetworkSettings) -> NetworkConfig:
    """The config of a network under other settings; its weights fit both.

    Zero points are no config: who predicts leaves the points out.

    Args:
        config: of the trained network.
        settings: those that are given replace the config's.

    Raises:
        UserError: the network has no such setting.
    """
    known = {"num_points", "detected_share", "nms_radius", "threshold", "num_samples"}
    if config.matcher.kind == "per_view":
        known.add("offset")
    settings.check_known(config.name, known)
    given = settings.given()
    detector: dict[str, Any] = {
        name: given[name] for name in ("detected_share", "nms_radius", "threshold") if name in given
    }
    if settings.num_points:
        detector["num_keypoints"] = settings.num_points
    matcher = {name: given[name] for name in ("num_samples",) if name in given}
    if settings.offset is not None:
        matcher["offsets"] = (-settings.offset, 0.0, settings.offset)
    return replace(
        config,
        detector=replace(config.detector, **detector),
        matcher=replace(config.matcher, **matcher),
    )
