"""The command `deltas recipe`: weights like the shipped ones, from one command."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deltas_nets.commands.calibrate import Calibrate
from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag
from deltas_nets.commands.train import encoder_file
from deltas_nets.config.recipes import RECIPES, RecipeName
from deltas_nets.errors import UserError
from deltas_nets.outputs.alone import Written
from deltas_nets.terminal import progress


@dataclass(frozen=True)
class Recipe(Command):
    """Train deltas-small from scratch to calibrated weights, as one command.

    night is for two CPU cores: small rooms, then large ones. hour is for a GPU and a dozen cores.
    Each part gets a folder in --out with its config, log, checkpoint and weights; at the end
    weights.safetensors has calibrated standard deviations, and a stage that redraws maps on which
    frames agreed. The same command goes on with a run that was stopped, though the calibration and
    the steps of that stage start again; --init with weights of an earlier one.

    Example: deltas recipe night --out runs/night --teacher-weights aliked-n16.pth
    """

    name: Annotated[tyro.conf.Positional[RecipeName], tyro.conf.arg(metavar="night|hour")]
    """What to do; deltas_nets/config/recipes.py has every setting."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder to write to."""
    teacher_weights: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Published weights of ALIKED n16, whose interest points the detector learns, as the shipped
    one did; Shi-Tomasi corners without them."""
    init: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Weights to go on from: of a shipped network, or a file. Without them only the encoder knows
    something, EfficientNet-Lite0 from the package of the train extra."""
    effort: float = 1.0
    """Share of the steps and of the rooms to calibrate on, 500 at most: 0.002 tries everything."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processes that render ahead; one for each core but one if not given."""
    debug: Flag = False
    """Show the traceback of an error."""

    going_on = "the same command goes on"

    @property
    def written(self) -> Written:
        """What no other run may write meanwhile."""
        return Written(self.out, "train")

    def run(self) -> None:
        """Run the command."""
        import torch

        from deltas_nets.distill.teachers import load_teacher
        from deltas_nets.outputs.atomic_files import check_writable
        from deltas_nets.train.processes import check_training
        from deltas_nets.train.recipe import Beginning, add_redraw, begin, run_parts, sign
        from deltas_nets.weights_file import load_model, weights_file

        if int(os.environ.get("WORLD_SIZE", "1")) > 1:
            what = "a recipe is for one process"
            raise UserError(what, "torchrun", "run its parts with deltas train")
        if not 0 < self.effort <= 10:
            what = f"no effort of {self.effort:g}"
            raise UserError(what, "--effort", "give more than 0, at most 10")
        if self.name == "hour" and not torch.cuda.is_available():
            what = "hour learns from 64 rooms at once, on a GPU, and there is none"
            raise UserError(what, "command line", "use night")
        check_training()
        workers = self._workers()
        init = None if self.init is None else weights_file(self.init)
        encoder = None
        if init is None:
            encoder = encoder_file("pretrained", "lite", otherwise="--init deltas-small")
        # Looked into before the folder remembers what it was begun with.
        if init is not None:
            load_model(init)
        if self.teacher_weights is not None:
            load_teacher("aliked", self.teacher_weights)
        finished = self.out / "weights.safetensors"
        if finished.exists():
            raise UserError(
                "this recipe is finished", finished, "name a new folder, or move the file away"
            )
        check_writable(self.out)
        beginning = Beginning(self.name, self.effort, init, self.teacher_weights)
        begin(self.out, beginning)
        recipe = RECIPES[self.name].scaled(self.effort).with_workers(workers)
        if self.teacher_weights is not None:
            recipe = recipe.taught_by("aliked")
        weights = run_parts(
            recipe,
            self.out,
            encoder=encoder,
            init=init,
            teacher=self.teacher_weights,
        )
        print(f"calibration on {recipe.calibration_rooms} rooms for each number of views")
        calibrated = self.out / "calibrated.safetensors"
        Calibrate(
            out=calibrated,
            weights=str(weights),
            rooms=recipe.calibration_rooms,
            size=recipe.calibration_size,
            overwrite=True,
        ).run()
        steps, rooms = recipe.redraw_steps, recipe.redraw_rooms
        print(f"the stage that redraws: {rooms} rooms, {steps} steps")
        with progress("redraw", rooms + steps) as report:
            redrawn = add_redraw(recipe, calibrated, self.out, workers=workers, report=report)
        sign(redrawn, recipe, beginning)
        redrawn.replace(finished)
        print(f"finished weights in {finished}")

    def _workers(self) -> int:
        if self.workers is None:
            return max(1, (os.cpu_count() or 2) - 1)
        if self.workers < 0:
            raise UserError(f"no {self.workers} processes", "--workers", "give 0 or more")
        return self.workers
