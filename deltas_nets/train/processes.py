"""One process or many, on one machine or several: Fabric, told how it was launched."""

import os
import warnings
from typing import TYPE_CHECKING

from deltas_nets.config import TrainConfig
from deltas_nets.errors import UserError
from deltas_nets.extras import check_extra
from deltas_nets.train.loader import Part

if TYPE_CHECKING:
    from lightning_fabric import Fabric


def check_training() -> None:
    """Is the package installed that training needs?

    Raises:
        UserError: it is not.
    """
    check_extra("train", "lightning_fabric", wanted_by="training needs", where="deltas train")


def launch_fabric(config: TrainConfig) -> "Fabric":
    """Fabric with all processes running.

    Under ``torchrun`` and ``fabric run`` their number is theirs to say; otherwise the config's
    ``devices`` and ``num_nodes`` count, and the processes of this machine are started here.

    Raises:
        UserError: lightning-fabric is not installed, or the number of processes does not fit.
    """
    check_training()
    from lightning_fabric import Fabric

    # DDP says so of depthwise weights in channels-last order, which lie in memory as it wants.
    warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")
    launched = "LT_CLI_USED" in os.environ
    torchrun = "TORCHELASTIC_RUN_ID" in os.environ and not launched
    try:
        if launched:
            fabric = Fabric()  # reads what `fabric run` was told
        elif torchrun:
            local = int(os.environ["LOCAL_WORLD_SIZE"])
            nodes = int(os.environ["WORLD_SIZE"]) // local
            fabric = Fabric(devices=local, num_nodes=nodes)
        else:
            fabric = Fabric(devices=config.devices, num_nodes=config.num_nodes)
        check_batch_size(config, fabric.world_size)
        if not launched:
            fabric.launch()
    except (ValueError, RuntimeError) as error:
        said = str(error).splitlines()[0]
        raise UserError(
            f"the processes cannot be started ({said})",
            "--devices",
            "name as many devices as there are",
        ) from error
    return fabric


def check_batch_size(config: TrainConfig, processes: int) -> None:
    """Every pass of every process takes equally many rooms.

    Raises:
        UserError: they cannot.
    """
    parts = processes * config.accumulate
    if config.batch_size % parts:
        raise UserError(
            f"{config.batch_size} rooms do not divide into {processes} processes times "
            f"{config.accumulate} passes",
            "--batch-size",
            f"make it a multiple of {parts}",
        )


def part_of(fabric: "Fabric") -> Part:
    """The part of every step's rooms that this process holds."""
    return Part(fabric.global_rank, fabric.world_size)
