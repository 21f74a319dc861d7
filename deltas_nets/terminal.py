"""What commands show besides their results, progress and warnings, and how they are stopped."""

import contextlib
import os
import select
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

SECONDS_BETWEEN_LINES = 10.0
"""Of progress, where it is not shown on a terminal."""
READER_GONE = 141
"""Exit status where nobody reads what is printed any more, as the shell has it for others."""


def counted(count: int, noun: str) -> str:
    """A number of things.

    Example:
        >>> counted(1, "map"), counted(3, "view set")
        ('1 map', '3 view sets')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def warn(text: str) -> None:
    """Print one line on standard error, for what is not fatal."""
    print(f"deltas: warning: {text}", file=sys.stderr)


@contextlib.contextmanager
def without_warnings_of_pillow() -> Iterator[None]:
    """Pillow warns of large images and damaged ones with lines of its code, and libtiff by its own.

    Large ones are welcome, and of damaged ones our own line tells.
    """
    with warnings.catch_warnings(), _silent_libtiff():
        warnings.filterwarnings("ignore", module=r"PIL\.")
        yield


@contextlib.contextmanager
def _silent_libtiff() -> Iterator[None]:
    """libtiff prints what it thinks of a file past Python; where it can be found it does not."""
    import ctypes

    from PIL import _imaging

    setters, before = [], []
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(_imaging.__file__)  # which knows the libraries that it is linked to
        setters = [library.TIFFSetErrorHandler, library.TIFFSetWarningHandler]
    for setter in setters:
        setter.argtypes, setter.restype = [ctypes.c_void_p], ctypes.c_void_p
        before.append(setter(None))
    try:
        yield
    finally:
        for setter, handler in zip(setters, before, strict=True):
            setter(handler)


@contextlib.contextmanager
def progress(name: str, total: int) -> Iterator[Callable[[str], None]]:
    """Progress on standard output; the value is called for every finished frame.

    A terminal gets a bar, which is gone when all is done; a pipe or a file gets a line every ten
    seconds. An error is alone on its stream.
    """
    if not sys.stdout.isatty():
        lines = Lines(name, total)
        yield lambda _: lines.advance()
        return
    from rich.progress import Progress, TextColumn

    columns = TextColumn("{task.description}", markup=False), *Progress.get_default_columns()[1:]
    # A console of its own: rich's common one keeps what other libraries make of it.
    with Progress(*columns, console=table_console(), transient=True) as bar:
        task = bar.add_task(name, total=total)
        yield lambda _: bar.advance(task)


def table_console() -> "Console":
    """What prints tables: names in them are people's, whose brackets and colons are no markup."""
    from rich.console import Console

    return Console(markup=False, emoji=False)


class Lines:
    """Progress in lines, at least ten seconds apart: "depth: 12 of 186"."""

    def __init__(self, name: str, total: int, *, done: int = 0) -> None:
        self.name, self.total, self.done = name, total, done
        self._told = time.monotonic()

    def advance(self, more: str = "") -> None:
        """One is done, of which there is more to tell."""
        self.done += 1
        if time.monotonic() - self._told >= SECONDS_BETWEEN_LINES:
            print(f"{self.name}: {self.done} of {self.total}{more}", flush=True)
            self._told = time.monotonic()


@contextlib.contextmanager
def silent_without_reader() -> Iterator[None]:
    """End the program without a word where standard output is a pipe that nobody reads any more."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        if not _reader_is_gone():  # but another process of ours
            raise
        # What is left in the buffer is written when Python ends, and must not fail there.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(READER_GONE)


def _reader_is_gone() -> bool:
    if not hasattr(select, "poll"):  # on Windows
        return True
    waiting = select.poll()
    waiting.register(sys.stdout.fileno(), 0)
    return any(event & select.POLLERR for _, event in waiting.poll(0))


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
