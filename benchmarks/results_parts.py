"""What is measured for docs/results.md, part by part: commands, and what they take."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from deltas_nets.ablations.paper import PAPER

RESULTS = Path("docs/results")
GIVEN = Path("captures")
"""Where captures and weights are linked to, so that commands in records run again as they are."""
LENGTHS = (2, 3, 4, 5, 7)
CAPTURES = {"walk": "headset walk", "scenes7": "7-Scenes, registered"}
HEARD = (3, 7)
CURVES = ("translation", "rotation", "calibration", "blur", "exposure", "views", "depth-range")
SAME = ("order", "units")
"""Curves that may not change; they have no figure on the page."""
LEARNED = {
    "aliked": "aliked-n16.pth",
    "disk": "disk-depth-save.pth",
    "xfeat": "xfeat.pt",
    "superpoint": "superpoint.pth",
}
"""Detectors of others, by the files that their weights are called here."""
STEPS = {"points": 9, "ratio": 5, "nms": 5, "threshold": 4, "samples": 4, "sparse": 3}
OF_CURVE = {"calibration": 7, "blur": 5, "exposure": 5, "views": 14, "order": 5, "units": 9}
ROOMS, PAIRS = 4, 80

Command = tuple[str, ...]
SETS = ("--view-sets", "view_sets.json")


@dataclass(frozen=True)
class Part:
    """Commands that belong together.

    Attributes:
        name: of the part.
        commands: one after the other; the first word is a program, "deltas" or "python".
        seconds: of one core, as measured; with two parts at once that of a part is longer.
        alone: whether nothing else may run beside it, as it is timed.
        clears: folders and files that the commands make anew.
    """

    name: str
    commands: tuple[Command, ...]
    seconds: float
    alone: bool = False
    clears: tuple[Path, ...] = ()


def parts() -> Iterator[Part]:
    """All of them; the longest of those that may run together first."""
    yield from of_cost()
    yield from of_detectors()
    yield from of_scenes()
    yield from of_rooms()
    yield from of_steps()


def of_cost() -> Iterator[Part]:
    """What networks cost, and what baselines do: times are among the figures."""
    cost = ("deltas", "cost", "--json", f"{RESULTS}/cost.json")
    yield Part("cost", (cost,), 45, alone=True)
    methods = "deltas-small plane-sweep colmap-sparse colmap-densified true-points no-points"
    table = ("python", "benchmarks/baselines.py", f"{GIVEN}/walk", "3", "25", "--threads", "1")
    more = ("--only", "nothing", *methods.split(), "--json", f"{RESULTS}/baselines.json")
    yield Part("baselines", ((*table, *more),), 150, alone=True)


def of_detectors() -> Iterator[Part]:
    """Table 1, with the detectors whose weights are given."""
    weights = GIVEN / "weights"
    learned = [f"{n}={weights / file}" for n, file in LEARNED.items() if (weights / file).exists()]
    named = ("--detectors", "orb", "sift", "ours", *learned)
    walk = ("deltas", "detectors", f"{GIVEN}/walk", *SETS, *named, "spread")
    all_points, fewer = (f"{RESULTS}/{name}.json" for name in ("detectors", "detectors_300"))
    yield Part("detectors", ((*walk, "--json", all_points),), 320)
    of_300 = (*walk, "--num-points", "300", "--json", fewer)
    yield Part("detectors, 300 points", (of_300,), 320)
    pairs = f"{GIVEN}/pairs/pairs_with_gt.txt"
    if Path(pairs).exists():
        size = ("--work-size", "480", "640", "--json", f"{RESULTS}/relative_poses.json")
        command = ("deltas", "detectors", pairs, *named, *size)
        yield Part("relative poses", (command,), 60)


def of_scenes() -> Iterator[Part]:
    """Tables 2 and 3: each length alone, plane sweep, and maps that have heard each other."""
    for name in CAPTURES:
        capture = f"{GIVEN}/{name}"
        for views in HEARD:
            maps, file = GIVEN / "maps" / f"{name}-{views}", depth_file(f"{name}-{views}-heard")
            out = ("--format", "npz", "--no-page", "--out", str(maps))
            predict = ("deltas", "depth", capture, *SETS, "--views", str(views), *out)
            score = ("deltas", "evaluate", capture, "--predictions", str(maps), "--json", file)
            yield Part(f"{name}, {views} views, heard", (predict, score), 90, clears=(maps,))
            swept = ("--weights", "plane-sweep", "--json", depth_file(f"{name}-{views}-sweep"))
            command = ("deltas", "evaluate", capture, *SETS, "--views", str(views), *swept)
            yield Part(f"{name}, {views} views, plane sweep", (command,), 12 * views)
        for views in LENGTHS:
            file = depth_file(f"{name}-{views}")
            command = ("deltas", "evaluate", capture, *SETS, "--views", str(views), "--json", file)
            yield Part(f"{name}, {views} views", (command,), 8 + 5 * views)


def of_rooms() -> Iterator[Part]:
    """Tables 2 to 4 by the paper's protocols, on procedural rooms in the layouts of their data."""
    scenes, pairs = GIVEN / "rooms", GIVEN / "room_pairs"
    made = ("python", "benchmarks/room_scenes.py")
    protocol = ("--data", "scannet", "--protocol", "paper", "--gap", "1", "--every", "1")
    commands: list[Command] = [(*made, "scannet", str(scenes), str(ROOMS))]
    for views in LENGTHS:
        how = (*protocol, "--views", str(views), "--json", depth_file(f"rooms-{views}"))
        commands.append(("deltas", "evaluate", str(scenes), *how))
    yield Part("rooms as ScanNet", tuple(commands), 130, clears=(scenes,))
    make = (*made, "demon", str(pairs), str(PAIRS))
    score = ("deltas", "evaluate", str(pairs), "--json", depth_file("pairs"))
    yield Part("pairs as DPSNet", (make, score), 150, clears=(pairs,))
    picture = ("python", "benchmarks/results_picture.py", f"{RESULTS}/rooms.jpg")
    yield Part("picture of rooms", (picture,), 25)


def of_steps() -> Iterator[Part]:
    """The supplement's tables, and curves."""
    for table in PAPER:
        if table != "offsets":  # deltas-small has none
            out = RESULTS / "ablations"
            command = ("deltas", "ablate", table, f"{GIVEN}/walk", *SETS, "--sets", "25")
            seconds = 5 + 13 * STEPS.get(table, 1)
            journal = out / f"{table}.jsonl"
            yield Part(table, ((*command, "--out", str(out)),), seconds, clears=(journal,))
    for curve in (*CURVES, *SAME):
        out = RESULTS / "robustness"
        sets = () if curve == "views" else SETS  # it wants eight of each
        command = ("deltas", "robustness", curve, f"{GIVEN}/walk", *sets, "--sets", "25")
        seconds = 5 + 13 * OF_CURVE.get(curve, 6)
        journal = out / f"{curve}.jsonl"
        yield Part(curve, ((*command, "--out", str(out)),), seconds, clears=(journal,))


def depth_file(name: str) -> str:
    """Of a record of `deltas evaluate`."""
    return f"{RESULTS}/depth/{name}.json"
