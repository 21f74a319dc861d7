"""Ctrl-C and SIGTERM end a run between two steps, so that none is lost or half done."""

import signal
import threading
from types import FrameType
from typing import Any


class StopRequest:
    """Notices the signals instead of being torn apart by them.

    A second Ctrl-C stops at once, where it is. In a thread that gets no signals it does nothing.

    Example:
        >>> with StopRequest() as request:
        ...     signal.raise_signal(signal.SIGTERM)
        ...     request.made
        True
    """

    def __init__(self) -> None:
        self.made = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "StopRequest":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._notice)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _notice(self, number: int, frame: FrameType | None) -> None:
        # torchrun answers Ctrl-C with SIGTERM on top: that is the same request, not a second one.
        if self.made and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.made = True
