"""Ctrl-C and SIGTERM end a run between two steps, so that none is lost or half done."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

WAITING = b"\ndeltas: stopping after this step; Ctrl-C again stops at once\n"


class StopRequest:
    """Notices the signals instead of being torn apart by them.

    A second Ctrl-C stops at once, where it is. In a thread that gets no signals it does nothing.

    Args:
        tells: whether to say on standard error that the request was heard: a step may take a
            minute.

    Example:
        >>> with StopRequest() as request:
        ...     signal.raise_signal(signal.SIGTERM)
        ...     request.made
        True
    """

    def __init__(self, *, tells: bool = False) -> None:
        self._tells = tells
        self.made = False
        self._waits = True
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "StopRequest":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._notice)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @contextmanager
    def obeyed_at_once(self) -> Iterator[None]:
        """Inside, where nothing is lost if it is left undone, a request is not made to wait.

        Raises:
            KeyboardInterrupt: it is made, or was made before.
        """
        if self.made:
            raise KeyboardInterrupt
        self._waits = False
        try:
            yield
        finally:
            self._waits = True

    def _notice(self, number: int, frame: FrameType | None) -> None:
        # torchrun answers Ctrl-C with SIGTERM on top: that is the same request, not a second one.
        again = self.made and number == signal.SIGINT
        if self._tells and self._waits and not self.made:
            # Not by print: what the signal interrupts may be printing, and holds its locks.
            os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, WAITING)
        self.made = True
        if again or not self._waits:
            # Once is enough: what is printed and closed on the way out is not torn apart.
            self._waits = True
            raise KeyboardInterrupt
