"""Run a recipe part by part; a run that was stopped goes on in the part that was not finished."""

from collections.abc import Callable
from pathlib import Path

from deltas_nets.config.recipes import Recipe
from deltas_nets.train.checkpoint import CHECKPOINT
from deltas_nets.train.fit import fit
from deltas_nets.train.resume import check_continues
from deltas_nets.train.start import Start


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
