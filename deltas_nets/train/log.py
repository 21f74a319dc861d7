"""What a run tells: a progress bar, a line of JSON every few steps, and TensorBoard's curves."""

import json
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from deltas_nets.config import TrainConfig, to_dict
from deltas_nets.outputs.atomic_files import cannot_write, plain, write_atomically
from deltas_nets.terminal import Lines, table_console

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

LOG = "log.jsonl"
CURVES = "tensorboard"


class RunLog:
    """A log that writes nothing, for all processes but the first."""

    def __enter__(self) -> "RunLog":
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is open."""

    def progress(self, step: int) -> None:
        """Show that so many steps are done."""

    def losses(
        self, step: int, losses: Mapping[str, float], *, rate: float, seconds: float
    ) -> None:
        """The losses of a step, its learning rate and how long it took."""

    def validation(self, step: int, metrics: Mapping[str, float]) -> None:
        """Metrics after a step."""

    def validated(self, step: int) -> bool:
        """Whether it has those of a step, or wants none."""
        return True


class FolderLog(RunLog):
    """Writes log.jsonl and, where the package tensorboard is installed, its event files.

    Args:
        folder: of the run.
        config: recorded as text.
        step: the run goes on after this one; what a killed run logged later is dropped.
        report: where messages go.
    """

    def __init__(
        self, folder: Path, config: TrainConfig, *, step: int, report: Callable[[str], None]
    ) -> None:
        self._place, file = folder, folder / LOG
        drop_later_entries(file, step)
        self.report = report
        self._validated = _validated_steps(file)
        self._held_out = "rooms" if config.data.scannet.validation is None else "scenes"
        self._file = file.open("a", encoding="utf-8")
        self._curves = _curves(folder / CURVES, step)
        if self._curves is not None:
            text = json.dumps(to_dict(config), indent=2).replace("\n", "\n    ")
            self._curves.add_text("config", f"    {text}", step)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[loss]}"),
            TimeRemainingColumn(),
            console=table_console(),
            disable=not sys.stdout.isatty(),
        )
        self._task = self._bar.add_task("training", total=config.steps, completed=step, loss="")
        self._lines, self._loss = Lines("training", config.steps, done=step), ""

    def __enter__(self) -> "FolderLog":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        with suppress(OSError):  # each line was flushed, or its refusal told
            self._file.close()
            if self._curves is not None:
                self._curves.close()

    def progress(self, step: int) -> None:
        """Move the bar; in a pipe or a file, which has none, tell in a line now and then."""
        self._bar.update(self._task, completed=step, loss=self._loss)
        if self._bar.disable:
            self._lines.advance(f", {self._loss}" if self._loss else "")

    def losses(
        self, step: int, losses: Mapping[str, float], *, rate: float, seconds: float
    ) -> None:
        """A line, a point on every curve, and the total beside the bar."""
        self._write({"step": step, **losses, "rate": rate, "seconds": seconds})
        self._draw("loss", losses, step)
        self._draw("training", {"rate": rate, "seconds": seconds}, step)
        self._loss = f"loss {losses['total']:.3f}"

    def validation(self, step: int, metrics: Mapping[str, float]) -> None:
        """A line, a point on every curve, and a message."""
        self._validated.add(step)
        self._write({"step": step, "validation": metrics})
        self._draw("validation", metrics, step)
        self.report(f"step {step}: held-out {self._held_out} {_in_words(metrics)}")

    def validated(self, step: int) -> bool:
        """Whether there is such a line."""
        return step in self._validated

    def _write(self, entry: Mapping[str, object]) -> None:
        try:
            print(json.dumps(plain(entry)), file=self._file, flush=True)
        except OSError as error:
            raise cannot_write(self._place / LOG, error) from error

    def _draw(self, group: str, values: Mapping[str, float], step: int) -> None:
        if self._curves is None:
            return
        try:
            for name, value in values.items():
                self._curves.add_scalar(f"{group}/{name}", value, step)
            self._curves.flush()
        except OSError as error:
            raise cannot_write(self._place / CURVES, error) from error


def _validated_steps(file: Path) -> set[int]:
    """Of a log without broken lines."""
    if not file.exists():
        return set()
    entries = (json.loads(line) for line in file.read_text(encoding="utf-8").splitlines())
    return {entry["step"] for entry in entries if "validation" in entry}


def drop_later_entries(file: Path, step: int) -> None:
    """Remove from a log what a killed run wrote after the step it resumes from.

    Those steps are taken again. A line that the kill cut short goes as well.
    """
    if not file.exists():
        return
    kept = []
    for line in file.read_text(encoding="utf-8").splitlines():
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        if entry["step"] <= step:
            kept.append(line + "\n")
    content = "".join(kept).encode("utf-8")
    write_atomically(file, lambda opened: opened.write(content))


def _curves(folder: Path, step: int) -> "SummaryWriter | None":
    """TensorBoard's writer; None where the package is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    # TensorBoard forgets what a killed run wrote after the step it resumes from.
    return SummaryWriter(str(folder), purge_step=step + 1)


def _in_words(metrics: Mapping[str, float]) -> str:
    words = {"abs_rel": "Abs Rel", "delta1": "delta<1.25", "sparse": "median of points"}
    return ", ".join(f"{words[name]} {value:.4f}" for name, value in metrics.items())
