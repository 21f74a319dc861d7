"""docs/results.md from stored results, and the stored results of what needs inference alone.

    python benchmarks/results.py measure WALK SCENES7   runs the commands, stores records
    python benchmarks/results.py                        writes docs/results.md from the records

WALK and SCENES7 are captures with sensor depth and view_sets.json: here the headset walk and the
registered 7-Scenes of the tables. Records lie in docs/results; each names its command. What needs
data or weights of others is not run by `measure` and keeps the record that it has.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from deltas_nets.ablations.paper import PAPER
from deltas_nets.evaluate.record import Record, Row, read_record, write_record

RESULTS, PAGE = Path("docs/results"), Path("docs/results.md")
LENGTHS = (2, 3, 4, 5, 7)
CAPTURES = {"walk": "headset walk", "scenes7": "7-Scenes, registered"}
DEPTH = {
    "abs_rel": "Abs Rel",
    "abs_diff": "Abs, m",
    "sq_rel": "Sq Rel, m",
    "rmse": "RMSE, m",
    "rmse_log": "RMSE log",
    "delta1": "d<1.25",
    "delta2": "d<1.25^2",
    "delta3": "d<1.25^3",
}
SHORT = {name: DEPTH[name] for name in ("abs_rel", "abs_diff", "sq_rel", "delta1", "delta2")}
DETECTORS = {
    "localisation": "MLE, px",
    "matching": "MScore",
    "points": "Num",
    "repeatability": "Rep",
    "rotation": "rot@5",
    "translation": "trans@5cm",
}
TABLE_1 = {  # the paper's, on ScanNet
    "ORB": (2.584, 0.194, 401, 0.613, 0.142, 0.064),
    "SIFT": (2.327, 0.201, 203, 0.496, 0.311, 0.148),
    "SURF": (2.577, 0.198, 268, 0.460, 0.303, 0.134),
    "SuperPoint": (2.545, 0.375, 129, 0.519, 0.489, 0.244),
    "the paper's network": (3.101, 0.329, 1511, 0.738, 0.518, 0.254),
}
TABLE_2 = (0.0932, 0.1540, 0.0506, 0.2505, 0.1426, 0.9287, 0.9767, 0.9893)
TABLE_4 = (0.1245, 0.2662, 0.0741, 0.3602, 0.1666, 0.8551, 0.9728, 0.9902)
TABLE_3 = {
    2: (0.106, 0.173, 0.057),
    4: (0.090, 0.150, 0.049),
    5: (0.088, 0.147, 0.048),
    7: (0.087, 0.144, 0.043),
}
CURVES = ("translation", "rotation", "calibration", "blur", "exposure", "views", "depth-range")


def main() -> None:
    """Measure, or write the page."""
    if sys.argv[1:2] == ["measure"]:
        for name, capture in zip(CAPTURES, sys.argv[2:4], strict=True):
            measure_depth(name, Path(capture))
        measure_pairs()
        for file in (RESULTS / "depth").glob("*.json"):
            keep_means(file)
        measure_inference(Path(sys.argv[2]))
    PAGE.write_text("\n".join(page()) + "\n", encoding="utf-8")


def deltas(*words: object) -> None:
    """Run a command of deltas; what it prints is seen."""
    print("deltas", *words, flush=True)
    program = Path(sys.executable).with_name("deltas")
    subprocess.run([program, *map(str, words)], check=True)


def keep_means(file: Path) -> None:
    """Of a record of `deltas evaluate`, the means over all scenes: what the page is made of."""
    record = read_record(file)
    last = record.rows[-1]["scene"]
    write_record(file, replace(record, rows=[r for r in record.rows if r["scene"] == last]))


def measure_depth(name: str, capture: Path) -> None:
    """Tables 2 and 3: each length alone, and maps that have heard each other."""
    sets = ("--view-sets", capture / "view_sets.json")
    for views in LENGTHS:
        file = RESULTS / "depth" / f"{name}-{views}.json"
        deltas("evaluate", capture, *sets, "--views", views, "--json", file)
    deltas(
        *("evaluate", capture, *sets, "--views", 3, "--weights", "plane-sweep"),
        *("--json", RESULTS / "depth" / f"{name}-plane-sweep.json"),
    )
    for views in (3, 7):
        with tempfile.TemporaryDirectory() as folder:
            out = ("--format", "npz", "--no-page", "--out", folder)
            deltas("depth", capture, *sets, "--views", views, *out)
            file = RESULTS / "depth" / f"{name}-{views}-heard.json"
            deltas("evaluate", capture, "--predictions", folder, "--json", file)


def measure_pairs() -> None:
    """Table 4, on rooms in its layout."""
    with tempfile.TemporaryDirectory() as folder:
        pairs = Path(folder) / "pairs"
        script = [sys.executable, "benchmarks/room_scenes.py", "demon", str(pairs), "40"]
        subprocess.run(script, check=True)
        deltas("evaluate", pairs, "--json", RESULTS / "depth" / "pairs.json")


def measure_inference(walk: Path) -> None:
    """Tables of the supplement, and curves."""
    sets = ("--view-sets", walk / "view_sets.json", "--sets", 6)
    for table in PAPER:
        if table != "offsets":  # deltas-small has none
            deltas("ablate", table, walk, "--out", RESULTS / "ablations", *sets)
    for curve in (*CURVES, "order", "units"):
        of_file = ("--sets", 6) if curve == "views" else sets
        deltas("robustness", curve, walk, "--out", RESULTS / "robustness", *of_file)


def page() -> Iterator[str]:
    """The lines of docs/results.md."""
    yield "# Results"
    yield ""
    yield "Written by `python benchmarks/results.py` from the records in [results](results), each"
    yield "of which names its command, data, weights, versions and machine. ScanNet and Sun3D could"
    yield "not be had: where the paper's figures are theirs, ours stand on other captures, and the"
    yield "two are no comparison. [evaluation](evaluation.md) says how to measure each on ScanNet."
    yield from detectors()
    yield from depth()
    yield from lengths()
    yield from pairs()
    yield from ablations()
    yield from curves()
    yield ""
    yield "## Other methods"
    yield ""
    yield "Plane sweep, COLMAP, a cost volume, networks of others: [baselines](baselines.md)."


def detectors() -> Iterator[str]:
    """Table 1."""
    yield from head("Table 1: detector and descriptor", RESULTS / "detectors.json")
    columns = list(DETECTORS.values())
    rows = [(f"{name} (paper, ScanNet)", *figures(values)) for name, values in TABLE_1.items()]
    for file, count in (("detectors", "all points"), ("detectors_300", "300 points")):
        record = read_record(RESULTS / f"{file}.json")
        rows += [
            (f"{row['detector']}, {count}", *figures(row[key] for key in DETECTORS))
            for row in record.rows
        ]
    yield from table(["", *columns], rows)


def depth() -> Iterator[str]:
    """Table 2."""
    yield from head("Table 2: three frames", RESULTS / "depth" / "walk-3.json")
    rows = [("the paper's network (ScanNet)", *figures(TABLE_2))]
    for name, words in CAPTURES.items():
        for file, method in (
            ("3", "deltas-small"),
            ("3-heard", "deltas-small, maps that hear each other"),
            ("plane-sweep", "plane sweep"),
        ):
            rows.append((f"{method} ({words})", *depth_of(f"{name}-{file}", DEPTH)))
    yield from table(["", *DEPTH.values()], rows)
    yield ""
    yield "Maps that hear each other: `deltas depth` with its usual passes, then `deltas evaluate"
    yield "--predictions`."


def lengths() -> Iterator[str]:
    """Table 3."""
    yield from head("Table 3: more frames", RESULTS / "depth" / "walk-7.json")
    three = ("abs_rel", "abs_diff", "sq_rel")
    rows = [
        (f"{count}: the paper's network (ScanNet)", *figures(values))
        for count, values in TABLE_3.items()
    ]
    for name, words in CAPTURES.items():
        for count in LENGTHS:
            rows.append((f"{count}: {words}", *depth_of(f"{name}-{count}", three)))
        rows.append((f"7, heard: {words}", *depth_of(f"{name}-7-heard", three)))
    yield from table(["frames", *(DEPTH[key] for key in three)], rows)


def pairs() -> Iterator[str]:
    """Table 4."""
    yield from head("Table 4: pairs as DPSNet prepared them", RESULTS / "depth" / "pairs.json")
    rows = [("the paper's network (Sun3D)", *figures(TABLE_4))]
    rows.append(("deltas-small (procedural rooms)", *depth_of("pairs", DEPTH)))
    yield from table(["", *DEPTH.values()], rows)


def ablations() -> Iterator[str]:
    """The tables of the supplement."""
    for name, paper in PAPER.items():
        file = RESULTS / "ablations" / f"{name}.json"
        if not file.exists():
            yield from ["", f"## Supplement: {name}", ""]
            yield "`deltas-small` lacks the setting, and the paper's weights could not be had."
            yield f"`deltas ablate {name} CAPTURE --out DIR --weights FILE` measures it."
        else:
            yield from head(f"Supplement: {name}", file)
        rows = [
            (f"{row.step} (paper, ScanNet)", *figures(getattr(row, key) for key in SHORT))
            for row in paper
        ]
        if file.exists():
            rows += [
                (f"{row['step']} ({row['weights']})", *figures(row.get(key) for key in SHORT))
                for row in read_record(file).rows
            ]
        yield ""
        yield from table(["", *SHORT.values()], rows)


def curves() -> Iterator[str]:
    """What disturbs."""
    for name in CURVES:
        file = RESULTS / "robustness" / f"{name}.json"
        yield from head(f"Robustness: {name}", file)
        yield f"![{name}](results/robustness/{name}.png)"
        yield ""
        rows = [
            (str(row["step"]), *figures(row.get(key) for key in ("abs_rel", "delta1")))
            for row in read_record(file).rows
        ]
        yield from table(["", "Abs Rel", "d<1.25"], rows)


def head(title: str, file: Path) -> list[str]:
    """A heading and how it was measured."""
    record: Record = read_record(file)
    return ["", f"## {title}", "", f"`{record.command}`", ""]


def depth_of(name: str, keys: Sequence[str] | dict[str, str]) -> list[str]:
    """Figures of a record of `deltas evaluate`: means over the dense maps of all its scenes."""
    rows = read_record(RESULTS / "depth" / f"{name}.json").rows
    row: Row = [row for row in rows if row["scores"] == "dense"][-1]
    return figures(row.get(key) for key in keys)


def figures(values: object) -> list[str]:
    """Numbers with three digits after the point."""
    return [
        "-" if value is None else str(value) if isinstance(value, int) else f"{value:.3f}"
        for value in values  # type: ignore[attr-defined]
    ]


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Markdown."""
    yield "| " + " | ".join(columns) + " |"
    yield "|" + "|".join(["--", *["--:"] * (len(columns) - 1)]) + "|"
    for row in rows:
        yield "| " + " | ".join(row) + " |"


if __name__ == "__main__":
    main()
