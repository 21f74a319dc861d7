"""Run a recipe part by part; a run that was stopped goes on in the part that was not finished."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from deltas_nets.config.recipes import Recipe, RecipeName
from deltas_nets.errors import UserError
from deltas_nets.outputs.alone import LOCK
from deltas_nets.outputs.atomic_files import write_json
from deltas_nets.train.checkpoint import CHECKPOINT
from deltas_nets.train.fit import fit
from deltas_nets.train.redraw import RedrawConfig, train_redraw
from deltas_nets.train.resume import check_continues
from deltas_nets.train.start import Start
from deltas_nets.weights_file import load_model, read_metadata, save_weights, sha256_of

RECORD = "recipe.json"


class Beginning(NamedTuple):
    """What decides the result of a recipe's command.

    Attributes:
        name: of the recipe.
        effort: share of it.
        init: weights that it starts from.
        teacher: weights of its teacher.
    """

    name: RecipeName
    effort: float
    init: Path | None
    teacher: Path | None

    def record(self) -> dict[str, object]:
        """What is written about it: of files what is in them, not where they are."""
        return {
            "recipe": self.name,
            "effort": self.effort,
            "init": _fingerprint(self.init),
            "teacher-weights": _fingerprint(self.teacher),
        }


def begin(folder: Path, beginning: Beginning) -> None:
    """Write what a recipe begins with, or compare it with what an earlier run began with.

    Raises:
        UserError: names what differs; the folder holds something else, or its record cannot be
            read.
    """
    file, record = folder / RECORD, beginning.record()
    if not file.exists():
        found = folder.iterdir() if folder.exists() else ()
        if any(not LOCK.fullmatch(file.name) for file in found):
            what = "the folder holds something else"
            raise UserError(what, folder, "name a new folder with --out")
        folder.mkdir(parents=True, exist_ok=True)
        write_json(file, record)
        return
    try:
        before = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UserError(f"not readable ({error})", file, "name a new folder with --out") from None
    for name, value in record.items():
        if before.get(name) != value:
            was = "without it" if before.get(name) is None else f"with {before[name]}"
            option = "what was begun there" if name == "recipe" else f"--{name}"
            raise UserError(
                f"the recipe in this folder was begun {was}: {name}",
                file,
                f"give {option} as then, or name a new folder with --out",
            )


def _fingerprint(file: Path | None) -> str | None:
    if file is None:
        return None
    return f"{file.name}, SHA-256 {sha256_of(file)}"


def run_parts(
    recipe: Recipe,
    folder: Path,
    *,
    encoder: Path | None = None,
    init: Path | None = None,
    teacher: Path | None = None,
    report: Callable[[str], None] = print,
) -> Path:
    """Train all parts, each from the weights of the one before.

    Args:
        recipe: of trainings.
        folder: gets a folder for each part, with its config, log, checkpoint and weights.
        encoder: an EfficientNet-Lite0 checkpoint that the first part starts from.
        init: weights that the first part starts from instead.
        teacher: weights of the teacher that the parts name.
        report: gets lines about what is done.

    Returns:
        The weights of the last part.

    Raises:
        UserError: what is in the folder is of another recipe, a file does not fit, or a part
            failed.
        KeyboardInterrupt: Ctrl-C or SIGTERM; the step was finished and saved.
    """
    begun = [part for part in recipe.parts if (folder / part.name / CHECKPOINT).exists()]
    for part in begun:  # before hours are spent on the first of them
        check_continues(folder / part.name, part.config)
    weights = init
    for number, part in enumerate(recipe.parts, start=1):
        report(f"part {number} of {len(recipe.parts)}: {part.name}, {part.config.steps} steps")
        if part in begun:
            start = Start(resume=True, teacher=teacher)
        elif weights is None:
            start = Start(encoder=encoder, teacher=teacher)
        else:
            start = Start(init=weights, teacher=teacher)
        weights = fit(part.config, folder / part.name, start, report=report)
    assert weights is not None, "a recipe has parts"
    return weights


def add_redraw(
    recipe: Recipe,
    weights: Path,
    folder: Path,
    *,
    workers: int,
    report: Callable[[str], None] = lambda _: None,
) -> Path:
    """Train the stage that redraws, the last of a recipe; its rooms are kept in the folder.

    Args:
        recipe: its numbers of steps and rooms.
        weights: calibrated.
        folder: gets the rooms, a log and the weights.
        workers: processes that make rooms.
        report: called after every room and every step.

    Returns:
        The weights with the stage.
    """
    config = RedrawConfig(
        folder / "redrawn.safetensors",
        init=str(weights),
        steps=recipe.redraw_steps,
        num_rooms=recipe.redraw_rooms,
        sizes=recipe.redraw_sizes,
        workers=workers,
        cache=folder / "heard-rooms",
        log=folder / "redraw.jsonl",
    )
    return train_redraw(config, overwrite=True, report=report)


def sign(weights: Path, recipe: Recipe, beginning: Beginning) -> None:
    """Add to weights which recipe made them: a part's own record knows of no other part."""
    parts = [
        {
            "name": part.name,
            "steps": part.config.steps,
            "seed": part.config.seed,
            "rooms": [part.config.data.seed, part.config.data.seed + part.config.data.num_rooms],
        }
        for part in recipe.parts
    ]
    said = json.dumps(beginning.record() | {"parts": parts})
    save_weights(weights, load_model(weights), read_metadata(weights) | {"recipe": said})
