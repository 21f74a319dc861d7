"""The lines of docs/results.md, made of stored records and of what the paper reports."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from results_paper import GMACS, TABLE_1, TABLE_2, TABLE_3, TABLE_4
from results_parts import (
    CAPTURES,
    CURVES,
    HEARD,
    LENGTHS,
    PAIRS,
    RESULTS,
    ROOMS,
    SAME,
    depth_file,
    parts,
)

from deltas_nets.ablations.paper import PAPER, SPARSE_RATIO, PaperRow
from deltas_nets.ablations.report import ON_SCANNET
from deltas_nets.evaluate.record import Record, Row, read_record

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
THREE = {name: DEPTH[name] for name in ("abs_rel", "abs_diff", "sq_rel")}
OF_SUPPLEMENT = {
    n: DEPTH[n] for n in ("abs_rel", "abs_diff", "sq_rel", "delta1", "delta2", "delta3")
}
DETECTORS = {
    "localisation": "MLE, px",
    "matching": "MScore",
    "points": "Num",
    "repeatability": "Rep",
    "one_to_one": "Rep, 1:1",
    "rotation": "rot@5",
    "translation": "trans@5cm",
    "translation_median": "median, m",
}
HEAD = Path(__file__).with_name("results_head.md")


def page() -> Iterator[str]:
    """All of it."""
    yield HEAD.read_text(encoding="utf-8").rstrip()
    yield from taken()
    yield from detectors()
    yield from three_frames()
    yield from lengths()
    yield from pairs()
    yield from cost()
    yield from maps()
    for name in ("sparse", "ratio", "points", "nms", "threshold", "samples", "offsets"):
        yield from of_supplement(name)
        if name == "ratio":
            yield from sparse_ratio()
    yield from of_supplement("architecture")
    yield from curves()
    yield from ["", "## Other methods", ""]
    yield "Networks of others, a cost volume of the same training: [baselines](baselines.md)."


def taken() -> Iterator[str]:
    """How long `measure` takes."""
    record = found("times")
    known = {row["part"]: row["seconds"] for row in record.rows} if record else {}
    if record is not None and all(known.get(part.name) for part in parts()):
        minutes = sum(float(row["seconds"] or 0) for row in record.rows) / 60
        yield ""
        where = f"{record.machine['processor']}, {record.machine['cores']} cores"
        count = len(record.rows)
        yield f"Its {count} parts took {minutes:.0f} min if added up; two run at once ({where})."


def detectors() -> Iterator[str]:
    """Table 1."""
    both = {words: found(name) for name, words in (("detectors", "all"), ("detectors_300", "300"))}
    yield from head("Table 1: detector and descriptor", *both.values())
    rows = [
        (f"{name} (paper, ScanNet)", *figures([*values[:4], None, *values[4:], None]))
        for name, values in TABLE_1.items()
    ]
    for words, record in both.items():
        for row in record.rows if record else ():
            shown = {**row, "points": round(float(row["points"] or 0))}
            rows.append((f"{row['detector']}, {words} points", *figures(of(shown, DETECTORS))))
    yield from table(["", *DETECTORS.values()], rows)
    relative = found("relative_poses")
    if relative is not None:
        yield ""
        yield "Eight pairs of ScanNet without depth, shares of right rotations and directions:"
        yield from head("", relative)
        keys = [f"{what}_{limit}" for what in ("rotation", "direction") for limit in (5, 10, 20)]
        rows = [(str(row["detector"]), *figures(of(row, keys))) for row in relative.rows]
        yield from table(["", *(key.replace("_", "@") for key in keys)], rows)


def three_frames() -> Iterator[str]:
    """Table 2."""
    yield from head("Table 2: three frames", found("depth/walk-3"))
    rows = [(f"{name} (paper, ScanNet)", *figures(values)) for name, values in TABLE_2.items()]
    for name, words in CAPTURES.items():
        for file, method in (
            ("3", "deltas-small"),
            ("3-heard", "deltas-small, maps that hear each other"),
            ("3-sweep", "plane sweep"),
        ):
            rows += depth_row(f"{method} ({words})", f"{name}-{file}", DEPTH)
    rows += depth_row(f"deltas-small ({ROOMS} rooms)", "rooms-3", DEPTH)
    yield from table(["", *DEPTH.values()], rows)
    yield ""
    yield "Maps that hear each other: `deltas depth captures/walk --view-sets view_sets.json"
    yield "--views 3 --format npz --no-page --out captures/maps/walk-3`, then `deltas evaluate"
    yield "captures/walk --predictions captures/maps/walk-3`. Plane sweep: the command above with"
    yield "`--weights plane-sweep`. Rooms lie in ScanNet's layout and are scored by the paper's"
    yield "protocol with frames 1 apart (command: table 3)."


def lengths() -> Iterator[str]:
    """Table 3."""
    yield from head("Table 3: more frames", found("depth/walk-7"), found("depth/rooms-7"))
    rows = []
    for count in LENGTHS:
        for name, values in TABLE_3.get(count, {}).items():
            rows.append((f"{count}: {name} (paper, ScanNet)", *figures(values)))
        for name, words in CAPTURES.items():
            rows += depth_row(f"{count}: {words}", f"{name}-{count}", THREE)
            if count in HEARD:
                rows += depth_row(f"{count}, heard: {words}", f"{name}-{count}-heard", THREE)
                rows += depth_row(f"{count}, plane sweep: {words}", f"{name}-{count}-sweep", THREE)
        rows += depth_row(f"{count}: {ROOMS} rooms", f"rooms-{count}", THREE)
    yield from table(["frames", *THREE.values()], rows)


def pairs() -> Iterator[str]:
    """Table 4."""
    yield from head("Table 4: pairs as DPSNet prepared them", found("depth/pairs"))
    rows = [(f"{name} (paper, Sun3D)", *figures(values)) for name, values in TABLE_4.items()]
    rows += depth_row(f"deltas-small ({PAIRS} procedural rooms)", "pairs", DEPTH)
    yield from table(["", *DEPTH.values()], rows)


def cost() -> Iterator[str]:
    """Section 4.3: what networks and baselines cost."""
    yield from ["", "## Cost", "", "`deltas cost`: two views of 240 x 320, 512 points", ""]
    rows = [(f"{name} (paper)", f"{value:.2f}", "", "") for name, value in GMACS.items()]
    file = RESULTS / "cost.json"
    if file.exists():
        content = json.loads(file.read_text(encoding="utf-8"))
        where = content["devices"]
        for name, network in content["networks"].items():
            total = network["total"]
            shown = (f"{total['gmacs_products']:.2f}", f"{total['parameters'] / 1e6:.2f} M")
            rows.append((f"{name}, {where[name]}", *shown, f"{total['seconds']:.2f}"))
    yield from table(["", "GMACs", "parameters", "s"], rows)
    record = found("baselines")
    if record is not None:
        yield from head("", record)
        shown = {"abs_rel": "Abs Rel", "delta1": "d<1.25", "gmacs_products": "GMACs"}
        shown |= {"seconds": "s a map", "peak_mb": "peak MB"}
        of_methods = [(str(row["method"]), *figures(of(row, shown))) for row in record.rows]
        yield from table(["", *shown.values()], of_methods)


def maps() -> Iterator[str]:
    """The figures of depth maps."""
    file = RESULTS / "rooms.jpg"
    yield from ["", "## Depth maps", ""]
    if not file.exists():
        yield "Not drawn yet."
        return
    yield f"`python benchmarks/results_picture.py {file}`: rooms that no training sees; photo, true"
    yield "depth, plane sweep, `deltas-small`; three views. Red is near. Of your own capture"
    yield "`deltas depth` writes [a page](page.md)."
    yield from ["", "![rooms](results/rooms.jpg)"]


def of_supplement(name: str) -> Iterator[str]:
    """One of the supplement's tables."""
    record = found(f"ablations/{name}")
    yield from head(f"Supplement: {name}", record)
    if record is None:
        yield "`deltas-small` lacks the setting, and the paper's weights could not be had."
        yield f"`deltas ablate {name} CAPTURE --out DIR --weights FILE` measures it."
        yield ""
    rows = paper_rows(PAPER[name])
    for row in ours(record):
        by = f" ({row['weights']})" if row["weights"] else ""
        rows.append((f"{row['step']}{by}", *figures(of(row, OF_SUPPLEMENT))))
    if name == "sparse":
        rows += [
            ("COLMAP, sparse points", *figures(of(row, OF_SUPPLEMENT, "sparse_")))
            for row in ours(record)
            if row["step"] == "COLMAP, interpolated"
        ]
    yield from table(["", *OF_SUPPLEMENT.values()], rows)
    if record is not None:
        yield from ["", f"![{name}](results/ablations/{name}.png)"]


def sparse_ratio() -> Iterator[str]:
    """The points of table "ratio" by themselves."""
    record = found("ablations/ratio")
    yield from head("Supplement: ratio, the points themselves", record)
    rows = paper_rows(SPARSE_RATIO)
    for row in ours(record):
        step = f"{row['step']} ({row['weights']})"
        rows.append((step, *figures(of(row, OF_SUPPLEMENT, "sparse_"))))
    yield from table(["", *OF_SUPPLEMENT.values()], rows)


def curves() -> Iterator[str]:
    """What disturbs."""
    for name in CURVES:
        record = found(f"robustness/{name}")
        yield from head(f"Robustness: {name}", record)
        if record is not None:
            yield from [f"![{name}](results/robustness/{name}.png)", ""]
            shown = {"abs_rel": "Abs Rel", "delta1": "d<1.25"}
            rows = [(str(row["step"]), *figures(of(row, shown))) for row in record.rows]
            yield from table(["", *shown.values()], rows)
    yield from ["", f"The steps of {' and '.join(SAME)} may change nothing; their records are in"]
    yield "[robustness](results/robustness)."


def found(name: str) -> Record | None:
    """A record, if it was measured."""
    file = RESULTS / f"{name}.json"
    return read_record(file) if file.exists() else None


def head(title: str, *records: Record | None) -> Iterator[str]:
    """A heading and how it was measured."""
    yield from ["", f"## {title}", ""] if title else [""]
    for record in records:
        if record is not None:
            yield from [f"`{record.command}`", ""]


def ours(record: Record | None) -> list[Row]:
    """The rows that are not the paper's."""
    return [row for row in (record.rows if record else ()) if row["weights"] != ON_SCANNET]


def paper_rows(rows: Sequence[PaperRow]) -> list[tuple[str, ...]]:
    """Of the supplement."""
    return [
        (f"{row.step} (paper, ScanNet)", *figures(getattr(row, key) for key in OF_SUPPLEMENT))
        for row in rows
    ]


def depth_row(title: str, name: str, keys: Iterable[str]) -> list[tuple[str, ...]]:
    """Means over the dense maps of all scenes of a record of `deltas evaluate`, if it is there."""
    record = found(depth_file(name).removeprefix(f"{RESULTS}/").removesuffix(".json"))
    if record is None:
        return []
    row: Row = [row for row in record.rows if row["scores"] == "dense"][-1]
    return [(title, *figures(of(row, keys)))]


def of(row: Mapping[str, object], keys: Iterable[str], prefix: str = "") -> list[object]:
    return [row.get(prefix + key) for key in keys]


def figures(values: Iterable[object]) -> list[str]:
    """Numbers with three digits after the point."""
    return [
        "-" if value is None else str(value) if isinstance(value, int) else f"{value:.3f}"
        for value in values
    ]


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Markdown."""
    yield "| " + " | ".join(columns) + " |"
    yield "|" + "|".join(["--", *["--:"] * (len(columns) - 1)]) + "|"
    for row in rows:
        yield "| " + " | ".join(row) + " |"
