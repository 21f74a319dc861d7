"""A long capture from photos to a mesh, by one command: time and memory.

    python benchmarks/thousand_frames.py CAPTURE [FRAMES] [FLAGS ...]

The frames of CAPTURE are played forth and back until there are so many (1000), as a capture of its
own; then `deltas depth --views 3 --work-size 240 320 --mesh` runs on it, with other FLAGS as given.
Memory is the largest resident size of the process, and what it was at quarters of the time.
"""

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from itertools import chain, cycle, islice
from pathlib import Path

import psutil

from deltas_nets import open_capture
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.saving import save_capture

FLAGS = ("--views", "3", "--work-size", "240", "320", "--mesh")


def main() -> None:
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 1000
    with tempfile.TemporaryDirectory() as folder:
        played = Path(folder) / "played"
        write_played(Path(sys.argv[1]), count, played)
        command = ["deltas", "depth", str(played), "--out", str(Path(folder) / "out"), *FLAGS]
        began = time.perf_counter()
        process = subprocess.Popen([*command, *sys.argv[3:]], cwd=folder)
        sizes = []
        while process.poll() is None:
            sizes.append(resident(process.pid))
            time.sleep(1.0)
        seconds = time.perf_counter() - began
    quarters = ", ".join(f"{sizes[len(sizes) * part // 4 - 1]:.2f}" for part in (1, 2, 3, 4))
    print(
        f"{count} frames of {Path(sys.argv[1]).name}: {seconds:.0f} s, {seconds / count:.3f} s each"
    )
    print(f"  memory: at most {max(sizes):.2f} GB; at quarters {quarters}; {os.cpu_count()} cores")
    sys.exit(process.returncode)


def write_played(path: Path, count: int, out: Path) -> None:
    """A capture whose frames are those of another, forth and back, with ids of their own."""
    capture = open_capture(path)
    frames = list(capture.frames.values())
    played = islice(cycle(chain(frames, reversed(frames[1:-1]))), count)
    renamed = [replace(frame, id=f"{number:05d}") for number, frame in enumerate(played)]
    save_capture(
        replace(capture, frames=Frames.of(renamed, capture.frames.folder)), out, placing="link"
    )


def resident(pid: int) -> float:
    """GB of a process and those that it started."""
    try:
        family = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
        return sum(one.memory_info().rss for one in family) / 1e9
    except psutil.Error:
        return 0.0


if __name__ == "__main__":
    main()
