"""Flags that several commands share."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.errors import UserError
from deltas_nets.extras import usable_device
from deltas_nets.terminal import warn

if TYPE_CHECKING:
    from deltas_nets.captures.capture import Capture
    from deltas_nets.predict.depth_map import PredictConfig
    from deltas_nets.predict.predictor import Predictor


T = TypeVar("T")

Flag = tyro.conf.FlagCreatePairsOff[bool]
Network = Literal["deltas-small", "deltas-resnet50", "deltas-vgg9"]
NETWORKS: tuple[Network, ...] = ("deltas-small", "deltas-resnet50", "deltas-vgg9")


@dataclass(frozen=True)
class Prediction(Command):
    """A command that predicts: flags that all of them have."""

    weights: str = "deltas-small"
    """A shipped network, a weights file of `deltas train`, or the checkpoint that the paper's
    authors published; or a baseline: plane-sweep, colmap-sparse, colmap-densified, true-points,
    no-points (checkpoint and baselines are for depth, evaluate, ablate and robustness; of these
    only no-points states a confidence)."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """bfloat16 is as accurate, and faster where the processor multiplies it (AMX, NVIDIA); others
    emulate it. Geometry stays in float32."""
    depth_range: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="NEAR FAR")] = None
    """Nearest and farthest depth searched, metres; 0.5 10 if not given."""
    work_size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="HEIGHT WIDTH")] = None
    """What the network sees; chosen to suit it if not given. Of less than 192 256 maps are worse
    than the confidence that they state."""
    debug: Flag = False
    """Show the traceback of an error."""

    smaller = "lower --work-size, or use a machine with more"

    def predictor(self) -> "Predictor":
        """The network, where it is to run."""
        from deltas_nets.predict.predictor import load_predictor

        device = usable_device(self.device)
        return load_predictor(self.weights, device, precision=self.precision)

    def config(self, **more: Any) -> "PredictConfig":
        """The flags as a config, with nonsense refused."""
        from deltas_nets.predict.depth_map import PredictConfig

        fields = {"depth_range": self.range, "work_size": self.work_size, **more}
        return sensible(PredictConfig, **fields)

    @property
    def range(self) -> tuple[float, float]:
        """Of the search, where nothing but the flag says it."""
        return self.depth_range or (0.5, 10.0)


@dataclass(frozen=True)
class Captured:
    """A command that reads a capture: flags that say of it what its files do not."""

    intrinsics: Annotated[str | None, tyro.conf.arg(metavar="NUMBERS")] = None
    """Of all images, whatever the capture says: "fx fy cx cy", then k1 k2 p1 p2 k3 of a lens as
    OpenCV orders them, or freiburg1, 2, 3 of TUM RGB-D."""
    scale: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Metres in a unit of the capture, of its depth files too; 1 says that it is in metres."""
    scale_from: Annotated[Path | None, tyro.conf.arg(metavar="sensor|FILE")] = None
    """Make it metric by its sensor depth, which is in metres then, or by a file of measured depths:
    lines ID X Y METRES."""

    def opened(self, path: Path) -> "Capture":
        """The capture, in metres if --scale says how."""
        from deltas_nets.captures.scaled import in_metres

        if self.scale is not None and self.scale_from is not None:
            raise UserError("two scales", "--scale-from", "leave out one of it and --scale")
        capture = opened(path, self.intrinsics)
        if self.scale is None:
            return capture
        if capture.metric and self.scale != 1:
            warn(f"the capture is in metres already; --scale {self.scale:g} makes it another size")
        return in_metres(capture, self.scale)

    def in_metres(
        self, capture: "Capture", predictor: "Predictor", config: "PredictConfig"
    ) -> "Capture":
        """The capture in metres if --scale-from says how, else as it is."""
        from deltas_nets.captures.scaled import in_metres, scaled
        from deltas_nets.predict.first_look import scale_by_measurements, scale_by_sensor

        if self.scale_from is None:
            return capture
        if str(self.scale_from) == "sensor":
            scale = scale_by_sensor(predictor, capture, config)
            moved = scaled(capture, scale)  # depth files are in metres already
        else:
            scale = scale_by_measurements(predictor, capture, config, self.scale_from)
            moved = in_metres(capture, scale)
        print(f"a unit of the capture is {scale:.4g} m")
        return moved


def opened(path: Path, intrinsics: str | None) -> "Capture":
    """A capture whose images have the camera that ``--intrinsics`` states, if it does.

    Raises:
        UserError: there is none, or it cannot be read.
    """
    from deltas_nets.captures.camera_words import Intrinsics
    from deltas_nets.captures.opening import open_capture

    stated = None if intrinsics is None else Intrinsics.parse(intrinsics)
    return open_capture(path, intrinsics=stated)


def folder_for(capture: Path, made: str) -> Path:
    """Where outputs go if nobody says it: ``CAPTURE-depth``, here; a file's suffix is left out."""
    path = capture.resolve()
    return Path(f"{path.stem if path.is_file() else path.name}-{made}")


def sensible(config: Callable[..., T], **fields: Any) -> T:
    """A config of some flags, with nonsense refused in the config's own words.

    Raises:
        UserError: the config raises ValueError.
    """
    try:
        return config(**fields)
    except ValueError as error:
        raise UserError(str(error), "command line", "see --help of this command") from None
