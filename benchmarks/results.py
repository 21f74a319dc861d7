"""docs/results.md from stored results, and the stored results of what needs inference alone.

    python benchmarks/results.py measure WALK SCENES7 [--weights DIR] [--pairs DIR]
    python benchmarks/results.py                        writes docs/results.md from the records

WALK and SCENES7 are captures with sensor depth and view_sets.json: here the headset walk and the
registered 7-Scenes of the tables. --weights holds files of detectors of others (results_parts.py
has their names), --pairs image pairs without depth: pairs_with_gt.txt and images. All are linked to
from the folder captures, which git does not see: the records in docs/results name commands that run
again from there.

`measure` runs two parts at a time, each on one core, says how long the rest takes, and writes the
page. Stopped, it goes on where it was. Parts are measured again where their commands, what is given
or the code of the packages changed since; --only NAME ... looks at these parts alone, and --list
makes the links and says what would be done. What the commands print is in captures/logs.
"""

import argparse
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

from results_page import page
from results_parts import GIVEN, LEARNED, RESULTS, Part, parts

from deltas_nets.evaluate.record import Record, read_record, write_record
from deltas_nets.outputs.atomic_files import write_json

ROOT = Path(__file__).parents[1]
PAGE, TIMES = Path("docs/results.md"), RESULTS / "times.json"
STATE, LOGS = GIVEN / "measured.json", GIVEN / "logs"


class State:
    """Which parts are done, in a file: by name the fingerprint of what decides them."""

    def __init__(self) -> None:
        self._lock = Lock()
        self.parts: dict[str, Any] = json.loads(STATE.read_text()) if STATE.exists() else {}

    def done(self, part: Part, key: str) -> bool:
        """Whether the part was measured as it would be now."""
        known = self.parts.get(part.name, {})
        return known.get("key") == key and "seconds" in known

    def begun(self, part: Part, key: str) -> bool:
        """Whether it was stopped while it was measured so."""
        return bool(self.parts.get(part.name, {}).get("key") == key)

    def note(self, part: Part, **what: Any) -> None:
        with self._lock:
            self.parts[part.name] = what
            write_json(STATE, self.parts)
            took = {name: one.get("seconds") for name, one in sorted(self.parts.items())}
            rows = [{"part": name, "seconds": seconds} for name, seconds in took.items()]
            command = "python benchmarks/results.py measure captures/walk captures/scenes7"
            write_record(TIMES, Record("times", command=command, rows=rows))


def main() -> None:
    """Measure, or write the page."""
    os.chdir(ROOT)
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("what", nargs="?", choices=["measure"])
    parser.add_argument("walk", nargs="?", type=Path)
    parser.add_argument("scenes7", nargs="?", type=Path)
    parser.add_argument("--weights", type=Path, help="folder of weights of detectors of others")
    parser.add_argument("--pairs", type=Path, help="folder with pairs_with_gt.txt and images")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these parts alone")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument(
        "--list", action="store_true", help="make the links and say what would be done"
    )
    arguments = parser.parse_args()
    if arguments.what == "measure":
        given = {name: getattr(arguments, name) for name in ("walk", "scenes7", "weights", "pairs")}
        link({name: path for name, path in given.items() if path is not None})
        for name in ("walk", "scenes7"):
            if not (GIVEN / name / "view_sets.json").exists():
                sys.exit(f"{GIVEN / name} is no capture with view_sets.json: name WALK and SCENES7")
        measure(arguments.only, arguments.jobs, only_say=arguments.list)
    if not arguments.list:
        PAGE.write_text("\n".join(page()) + "\n", encoding="utf-8")


def link(given: dict[str, Path]) -> None:
    """Put what is given where commands name it."""
    GIVEN.mkdir(exist_ok=True)
    for name, path in given.items():
        place, there = GIVEN / name, path.resolve()  # before the link goes: it may be what is named
        if place.is_symlink():
            place.unlink()
        if not place.exists():
            place.symlink_to(there, target_is_directory=True)


def measure(only: Sequence[str] | None, jobs: int, *, only_say: bool) -> None:
    """Run what was not measured as it would be now."""
    known_names = [part.name for part in parts()]
    unknown = set(only or ()) - set(known_names)
    if unknown:
        sys.exit(f"no part is called {', '.join(sorted(unknown))}: {', '.join(known_names)}")
    chosen = [part for part in parts() if only is None or part.name in only]
    known, code = State(), fingerprint_of_code()
    keys = {part.name: key_of(part, code) for part in chosen}
    todo = [part for part in chosen if not known.done(part, keys[part.name])]
    whole = sum(part.seconds / (1 if part.alone else jobs) for part in todo)
    print(f"{len(todo)} of {len(chosen)} parts, about {whole / 60:.0f} min of {jobs} free cores")
    if only_say:
        for part in todo:
            print(f"{part.name}: {part.seconds / 60:.1f} min of a core")
            print(*(f"    {shlex.join(command)}" for command in part.commands), sep="\n")
        return
    began, left, failed = time.monotonic(), whole, []
    by_turn = [(1, [part for part in todo if part.alone]), (jobs, [p for p in todo if not p.alone])]
    for workers, some in by_turn:
        with ThreadPoolExecutor(workers) as pool:
            running = {pool.submit(run, part, keys[part.name], known): part for part in some}
            try:
                for finished in as_completed(running):
                    part, log = running[finished], finished.result()
                    left -= part.seconds / workers
                    passed = (time.monotonic() - began) / 60
                    how = f"failed, see {log}" if log else "done"
                    failed += [part.name] if log else []
                    print(f"{part.name}: {how}; {passed:.1f} min, about {left / 60:.0f} more")
            except KeyboardInterrupt:
                pool.shutdown(cancel_futures=True)
                sys.exit("stopped; the same command goes on")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}; the same command tries them again")


def run(part: Part, key: str, known: State) -> Path | None:
    """Run a part's commands; the file of what they said if one failed."""
    if not known.begun(part, key):
        clear(part)
    known.note(part, key=key)
    began, log = time.monotonic(), LOGS / f"{part.name.replace(' ', '_')}.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with log.open("w", encoding="utf-8") as told:
        for words in part.commands:
            program = Path(sys.executable)
            program = program if words[0] == "python" else program.with_name("deltas")
            command = [str(program), *words[1:]]
            if subprocess.run(command, env=environment, stdout=told, stderr=told).returncode:
                return log
    for words in part.commands:
        if "evaluate" in words:
            keep_means(Path(words[-1]))
    known.note(part, key=key, seconds=round(time.monotonic() - began, 1))
    for file in part.clears:
        file.unlink() if file.is_file() else None  # a journal is of no use to anybody else
    return None


def clear(part: Part) -> None:
    """Remove what a run of something else left behind."""
    for path in part.clears:
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)


def keep_means(file: Path) -> None:
    """Of a record of `deltas evaluate`, the means over all scenes: what the page is made of."""
    record = read_record(file)
    last = record.rows[-1]["scene"]
    write_record(file, replace(record, rows=[r for r in record.rows if r["scene"] == last]))


def key_of(part: Part, code: str) -> str:
    """Of what decides a part's figures: commands, code, and what was given."""
    given = [f"{path.resolve()} {path.stat().st_mtime}" for path in sorted(GIVEN.glob("*"))]
    links = [text for text in given if str(GIVEN.resolve()) not in text]
    files = [GIVEN / "weights" / file for file in LEARNED.values()]
    sizes = [f"{file.name} {file.stat().st_size}" for file in files if file.exists()]
    return hashlib.sha256(repr((part.commands, code, links, sizes)).encode()).hexdigest()[:16]


def fingerprint_of_code() -> str:
    """Of both packages, weights included, and of what makes rooms and tables here."""
    digest = hashlib.sha256()
    folders = ("deltas_geom", "deltas_nets")
    files = [file for folder in folders for file in Path(folder).rglob("*") if file.is_file()]
    files += [Path("benchmarks") / f"{n}.py" for n in ("baselines", "room_scenes")]
    for file in sorted(files):
        if "__pycache__" not in file.parts:
            digest.update(f"{file}".encode() + file.read_bytes())
    return digest.hexdigest()


if __name__ == "__main__":
    main()
