"""One run at a time writes a folder: a file beside what it writes says whose it is.

The file's name is all that it says, so that it is whole when it exists. What a killed run left
holds nobody up: its process is gone, or another one has its number by now.
"""

import contextlib
import os
import random
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

from deltas_nets.errors import UserError
from deltas_nets.terminal import warn

__all__ = ["LOCK", "Written", "alone"]

LOCK = re.compile(
    r"\.(?P<what>[a-z]+)(~(?P<part>[\w.-]+))?~(?P<pid>\d+)~(?P<began>\d*)~(?P<host>[\w.-]+)"
    r"\.deltas-lock"
)
"""Names of the files: what is written, by which process of which machine."""
STAT_STATE, STAT_BEGAN = 0, 19
"""Fields of /proc/PID/stat behind the name of the program, in brackets."""


class Written(NamedTuple):
    """What a run writes.

    Attributes:
        folder: where.
        what: the kind of things; others may be written into the folder meanwhile.
        part: of them that is written, as other runs may write the other ones; all if empty.
    """

    folder: Path
    what: str
    part: str = ""

    def meets(self, what: str, part: str | None) -> bool:
        """Whether another run of the folder writes the same."""
        return what == self.what and (not part or not self.part or part == self.part)


@contextlib.contextmanager
def alone(written: Written | None) -> Iterator[None]:
    """Nobody else writes the same meanwhile.

    A folder that is not there is made, and removed again if nothing is written. Where the system
    lets no file be made there, nothing is held: whoever writes will be told.

    Args:
        written: what; None of a run that writes nothing for long.

    Raises:
        UserError: a living process of this machine does. Of those of other machines nobody knows
            whether they live: they are a warning.
    """
    if written is None:
        yield
        return
    made = [folder for folder in (written.folder, *written.folder.parents) if not folder.exists()]
    own = _hold(written)
    try:
        yield
    finally:
        if own is not None:
            _let_go(own)
        with contextlib.suppress(OSError):  # there is something in it
            for folder in made:
                folder.rmdir()


def _hold(written: Written) -> IO[bytes] | None:
    """The file that says that this process writes, open; None where the system refuses."""
    other = None
    for again in (True, False):
        try:
            written.folder.mkdir(parents=True, exist_ok=True)
            own = (written.folder / _name(written)).open("wb")
        except OSError:
            return None
        # Two that begin at the same moment see each other, and the one that waits less goes on.
        other = _other(written, own.name)
        if other is None:
            return own
        _let_go(own)
        if again:
            time.sleep(random.uniform(0.01, 0.1))
    what = f"another run is writing here (process {other})"
    raise UserError(what, written.folder, "wait for it, stop it, or name another folder")


def _let_go(own: IO[bytes]) -> None:
    own.close()
    with contextlib.suppress(OSError):
        os.unlink(own.name)


def _name(written: Written) -> str:
    part = f"~{_plain(written.part)}" if written.part else ""
    pid = os.getpid()
    return f".{written.what}{part}~{pid}~{_began(pid) or ''}~{_host()}.deltas-lock"


def _other(written: Written, own: str) -> int | None:
    """The process of another run that writes the same; files of those that are gone are removed."""
    plain = written._replace(part=_plain(written.part))
    for file in written.folder.iterdir():
        held = LOCK.fullmatch(file.name)
        if held is None or str(file) == own or not plain.meets(held["what"], held["part"]):
            continue
        pid = int(held["pid"])
        if held["host"] != _host():
            warn(
                f"a run on another machine ({held['host']}, process {pid}) began to write into "
                f"{written.folder} and did not end; if it still runs, stop one of the two"
            )
        elif pid != os.getpid() and _lives(pid, held["began"]):
            return pid
        try:
            file.unlink(missing_ok=True)
        except PermissionError:
            if os.name == "nt":  # where a file that is open cannot be removed: its process lives
                return pid
    return None


def _lives(pid: int, began: str) -> bool:
    """Whether a process of this machine is there, and began then where the system knows when."""
    if Path("/proc/self/stat").exists():
        now = _began(pid)
        return now is not None and began in ("", now)
    if os.name == "nt":  # where os.kill would end it, and the file itself tells
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # of another user
        return True
    return True


def _began(pid: int) -> str | None:
    """When a process began, in ticks since the machine did; None if it is gone, or nobody knows."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[STAT_STATE] in "ZX" else fields[STAT_BEGAN]


def _host() -> str:
    return _plain(socket.gethostname()) or "unnamed"


def _plain(text: str) -> str:
    return re.sub(r"[^\w.-]", "_", text)[:60]
