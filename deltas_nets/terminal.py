"""What commands show besides their results: progress and warnings."""

import contextlib
import sys
from collections.abc import Callable, Iterator


def warn(text: str) -> None:
    """One line on standard error, for what is not fatal."""
    print(f"deltas: warning: {text}", file=sys.stderr)


@contextlib.contextmanager
def progress(name: str, total: int) -> Iterator[Callable[[str], None]]:
    """A progress bar on standard output; the value is called for every finished frame."""
    from rich.progress import Progress

    # On standard output, and gone when done: an error is alone on its stream.
    with Progress(transient=True) as bar:
        task = bar.add_task(name, total=total)
        yield lambda _: bar.advance(task)
