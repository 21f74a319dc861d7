"""What commands show besides their results, progress and warnings, and how they are stopped."""

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType


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


@contextlib.contextmanager
def stopped_like_ctrl_c() -> Iterator[None]:
    """SIGTERM raises KeyboardInterrupt, so that job schedulers leave whole summaries behind.

    In a thread that gets no signals it does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
