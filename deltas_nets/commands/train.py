"""The command `deltas train`."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import NETWORKS, Flag, Network
from deltas_nets.config import TRAIN_CONFIGS, TrainConfig
from deltas_nets.config.encoders import ENCODERS
from deltas_nets.errors import UserError
from deltas_nets.outputs.alone import Written

Preset = Literal[Network, "cost-volume"]
PRESETS: tuple[Preset, ...] = (*NETWORKS, "cost-volume")


@dataclass(frozen=True)
class Train(Command):
    """Train a network on procedural rooms, or on scenes in ScanNet's layout (--data scannet).

    Writes config.json, checkpoint.pt, weights.safetensors, log.jsonl and TensorBoard's curves into
    --out; a run that was stopped goes on with --resume, or from weights alone with --init and
    --start-step.

    Example: deltas train --out runs/first --steps 2000

    The paper's: deltas train --config deltas-resnet50 --data scannet --root DIR --out runs/paper

    On several GPUs: torchrun --nproc-per-node 4 -m deltas_nets.cli train --out runs/first
    """

    out: Path
    """Folder of the run; named after the network if not given."""
    preset: Annotated[Preset, tyro.conf.arg(name="config")] = "deltas-small"
    """Network and training to start from; the other flags change it. deltas-resnet50 and
    deltas-vgg9 are the paper's, with its losses and schedule; cost-volume has no points, and is
    there to be measured beside the others."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    teacher_weights: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Published weights of --teacher, or a network of ours; a resumed run wants them again."""
    resume: Flag = False
    """Go on from the checkpoint in --out, with the config recorded there. Only what changes no
    result may be given anew: --devices, --num-nodes, --data.cache, --data.workers, --root."""
    init: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Start from these weights: a shipped network's, or a file's."""
    start_step: int = 0
    """Go on in the schedule at this step (with --init)."""
    checkpoint_every: int = 200
    """Steps between checkpoints; Ctrl-C writes one too."""
    validate_every: int = 500
    """Steps between evaluations on rooms that no training sees, or on --data.validation."""
    encoder: str = "pretrained"
    """Weights for the encoder: "pretrained" is EfficientNet-Lite0 from the package of the train
    extra (the paper's backbones start from random weights), "none" starts from random weights,
    otherwise a file: EfficientNet-Lite0's, or ResNet-50's with the common key names."""
    debug: Flag = False
    """Show the traceback of an error."""

    going_on = "the same command with --resume goes on"
    smaller = "raise --accumulate, or lower --batch-size, --sizes, --max-views or --num-keypoints"

    @classmethod
    def parsed_as(cls, arguments: Sequence[str]) -> Any:
        """The flags' defaults: of the network that --config names, or the run that goes on.

        So whatever differs from the run was asked for.

        Raises:
            UserError: there is no run to go on with.
        """
        preset = preset_of(arguments)
        default = cls(out=Path("runs") / preset, preset=preset, config=TRAIN_CONFIGS[preset])
        helps = {"--help", "-h"} & set(arguments)
        if [*arguments[:1]] == ["train"] and "--resume" in arguments and not helps:
            from deltas_nets.train.checkpoint import load_config

            config = load_config(Path(value_of("--out", arguments) or default.out))
            default = replace(default, config=config, preset=preset_like(config))
        return Annotated[cls, tyro.conf.subcommand(name="train", default=default)]

    @property
    def written(self) -> Written | None:
        """What no other run may write meanwhile."""
        return Written(self.out, "train") if first_process() else None

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.outputs.atomic_files import check_writable
        from deltas_nets.train.fit import fit
        from deltas_nets.train.processes import check_training
        from deltas_nets.train.resume import check_continues
        from deltas_nets.train.start import Start
        from deltas_nets.weights_file import weights_file

        check_training()
        self._check_counts()
        if self.start_step and self.init is None:
            raise UserError("start from what?", "--start-step", "add --init FILE")
        config = self.config
        if self.resume:
            check_continues(self.out, config)
            if self.preset != preset_like(config):
                what = f"the run to go on with is of {config.network.name}"
                raise UserError(what, f"--config {self.preset}", "leave it out")
        if self.start_step >= config.steps:
            raise UserError(
                f"the schedule ends at {config.steps}", "--start-step", "start before that"
            )
        if not self.resume and (self.out / "checkpoint.pt").exists():
            raise UserError(
                "the folder holds another run", self.out, "add --resume or name a new folder"
            )
        check_writable(self.out)
        encoder = None
        if self.init is None and not (self.resume and self.encoder == "pretrained"):
            encoder = encoder_file(self.encoder, config.network.backbone)
        init = None if self.init is None else weights_file(self.init)
        start = Start(
            encoder,
            init,
            self.start_step,
            self.resume,
            self.teacher_weights,
            random_encoder=self.encoder == "none",
        )
        weights = fit(
            config,
            self.out,
            start,
            checkpoint_every=self.checkpoint_every,
            validate_every=self.validate_every,
        )
        if first_process():
            print(f"weights in {weights}")

    def _check_counts(self) -> None:
        for name, least in (("start_step", 0), ("checkpoint_every", 1), ("validate_every", 1)):
            value = getattr(self, name)
            if value < least:
                option = f"--{name.replace('_', '-')} {value}"
                raise UserError("too few steps", option, f"give {least} or more")


def first_process() -> bool:
    """Whether this is the process that writes, where several train together."""
    if "RANK" in os.environ:
        return os.environ["RANK"] == "0"
    # Those of one machine that Fabric starts, machines that are told their number, and Slurm's.
    names = ("LOCAL_RANK", "NODE_RANK", "SLURM_PROCID")
    return all(os.environ.get(name, "0") == "0" for name in names)


def preset_of(arguments: Sequence[str]) -> Preset:
    """What --config names: the defaults of the other flags depend on it."""
    name = value_of("--config", arguments)
    return next((network for network in PRESETS if network == name), "deltas-small")


def preset_like(config: TrainConfig) -> Preset:
    """The preset that a run's network is called after; networks of other names have the usual."""
    return next((preset for preset in PRESETS if preset == config.network.name), "deltas-small")


def value_of(option: str, arguments: Sequence[str]) -> str | None:
    """What follows an option, the last time if it is there twice."""
    value = None
    for word, following in pairwise([*arguments, ""]):
        name, equals, inside = word.partition("=")
        if name == option:
            value = inside if equals else following
    return value


def encoder_file(name: str, backbone: str, *, otherwise: str = "--encoder none") -> Path | None:
    """The file of ``--encoder``: the one named, none, or that of the backbone's package.

    Args:
        name: what ``--encoder`` says.
        backbone: the encoder that it is for.
        otherwise: the option of the command that needs no package.

    Raises:
        UserError: the package is not installed.
    """
    if name not in ("pretrained", "none"):
        return Path(name)
    wanted = ENCODERS[backbone].package
    if name == "none" or wanted is None:
        return None
    package = find_spec(wanted)
    if package is None or package.origin is None:
        raise UserError(
            "the pretrained encoder is not installed",
            wanted,
            f'pip install "deltas-depth[train]", or use {otherwise}',
        )
    (file,) = (Path(package.origin).parent / "models").glob("*.pth")
    return file
