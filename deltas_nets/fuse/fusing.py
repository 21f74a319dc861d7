"""A capture's depth maps become files of a cloud and a mesh; a run that was stopped goes on."""

import json
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from deltas_nets.captures.upright import up_of
from deltas_nets.errors import UserError
from deltas_nets.fuse.cloud import Cloud
from deltas_nets.fuse.config import FuseConfig
from deltas_nets.fuse.folder import check_folder, own_files
from deltas_nets.fuse.left_out import LeftOut, cure, doubt, mean_left_out
from deltas_nets.fuse.mesh import without_small_parts
from deltas_nets.fuse.prepared import PreparedViews
from deltas_nets.fuse.products import FUSED, FusedName
from deltas_nets.fuse.sizes import Sizes, check_memory, check_reach, look_at
from deltas_nets.fuse.sources import DepthSource
from deltas_nets.fuse.state import Sums, read_state, write_state
from deltas_nets.fuse.surface import surface
from deltas_nets.fuse.threads import own_threads
from deltas_nets.fuse.volume import BYTES_OF_BLOCK, Volume
from deltas_nets.outputs.atomic_files import check_writable, plain, write_json
from deltas_nets.outputs.beside import FUSE_STATE, FUSE_SUMMARY, FUSE_WRITER

__all__ = ["Fused", "fuse_capture"]

SECONDS_BETWEEN_STATES = 20.0
SHARE_OF_STATES = 0.1
"""Of the time that goes into writing states, at most."""
SMALL_PART = 100.0
"""Voxel sides squared: parts of a mesh with less area are specks of noise."""


class Fused(NamedTuple):
    """What was made.

    Attributes:
        frames: that have been added up.
        voxel: side of a voxel.
        counts: points, vertices and faces of what was made now; none of what was there.
        files: what there is.
        left_out: of the maps' depth; None if nothing was made now.
        doubt: a line on what was made now, where it is little.
    """

    frames: int
    voxel: float
    counts: Mapping[str, int]
    files: Sequence[Path]
    left_out: LeftOut | None = None
    doubt: str | None = None


def fuse_capture(
    source: DepthSource,
    out: Path,
    config: FuseConfig,
    products: Sequence[FusedName] = ("cloud", "mesh"),
    *,
    gigabytes: float = 4.0,
    device: str = "cpu",
    overwrite: bool = False,
    report: Callable[[str], None] = lambda _: None,
) -> Fused:
    """Fuse the maps of a source and write the products.

    Args:
        source: the maps.
        out: folder to write to.
        config: how.
        products: what is wanted.
        gigabytes: that the volume may take.
        device: where to compute.
        overwrite: replace what other settings made.
        report: called with the id of every frame that is added.

    Raises:
        UserError: a map is damaged, nothing is left of them, voxels are too fine, or the folder
            holds what other settings made. What was added up by then is kept, and the same call
            goes on.
    """
    files = {name: out / FUSED[name].file for name in products}
    for name, file in files.items():
        FUSED[name].check(file)
    check_writable(out)
    settings = json.loads(json.dumps(plain({**asdict(config), **source.settings})))
    settings["frames"] = list(source.ids)
    earlier = check_folder(out, files.values(), settings, overwrite=overwrite)
    if earlier and earlier["status"] == "complete" and all(map(Path.exists, files.values())):
        return Fused(len(source.ids), earlier["voxel"], {}, list(files.values()))
    source.check()
    with own_threads() as threads:
        sizes = look_at(source, config.voxel)
        kinds = {FUSED[name].of for name in products}
        if "surface" in kinds:
            check_memory(sizes, gigabytes)
        check_reach(sizes)
        sums = _sums(kinds, sizes, device, threads)
        out.mkdir(parents=True, exist_ok=True)
        head = {"writer": FUSE_WRITER, "voxel": sizes.voxel, "truncation": sizes.truncation}
        head["files"] = own_files(out, files.values(), settings)
        write_json(out / FUSE_SUMMARY, {**head, "status": "running", "settings": settings})
        left_out = _add_up(source, out, config, sums, settings, gigabytes, report)
        made, counts = _made(sums, sizes)
        if not all(counts.values()):
            # No settings hold the folder then: other ones, as the remedy has them, may follow.
            (out / FUSE_SUMMARY).unlink(missing_ok=True)
            (out / FUSE_STATE).unlink(missing_ok=True)
            raise _nothing(source, left_out, sizes, config)
        for name, file in files.items():
            FUSED[name].write(file, made[FUSED[name].of], up_of(source.capture))
    ended = {"status": "complete", "frames": len(source.ids), **counts}
    ended["left_out"] = {name: round(part, 4) for name, part in left_out._asdict().items()}
    write_json(out / FUSE_SUMMARY, {**head, **ended, "settings": settings})
    (out / FUSE_STATE).unlink(missing_ok=True)
    doubtful = doubt(counts, left_out, sizes, config)
    made_now = list(files.values())
    return Fused(len(source.ids), sizes.voxel, counts, made_now, left_out, doubtful)


def _sums(kinds: Collection[str], sizes: Sizes, device: str, threads: int) -> dict[str, Sums]:
    sums: dict[str, Sums] = {}
    if "points" in kinds:
        sums["points"] = Cloud(sizes.voxel, origin=sizes.origin, device=device)
    if "surface" in kinds:
        sums["surface"] = Volume(
            sizes.voxel, sizes.truncation, origin=sizes.origin, device=device, threads=threads
        )
    return sums


def _add_up(
    source: DepthSource,
    out: Path,
    config: FuseConfig,
    sums: Mapping[str, Sums],
    settings: Mapping[str, Any],
    gigabytes: float,
    report: Callable[[str], None],
) -> LeftOut:
    """Add all views that no earlier run has added; what all of them leave out."""
    made_of = {"settings": settings, "sums": sorted(sums)}
    done = read_state(out, sums, made_of)
    for id in done:
        report(id)
    kept = len(done)
    saved, saving = time.monotonic(), 0.0
    try:
        left = [id for id in source.ids if id not in done]
        for id, view, left_out in PreparedViews(source, config).ahead(left):
            for added in sums.values():
                added.add(view)
            done[id] = left_out
            report(id)
            _check_size(sums.get("surface"), gigabytes)
            now = time.monotonic()
            if now - saved > max(SECONDS_BETWEEN_STATES, saving / SHARE_OF_STATES):
                write_state(out, sums, done, made_of)
                saved, saving, kept = time.monotonic(), time.monotonic() - now, len(done)
    finally:
        if kept < len(done) < len(source.ids):
            write_state(out, sums, done, made_of)
    return mean_left_out(done.values())


def _check_size(volume: Sums | None, gigabytes: float) -> None:
    if isinstance(volume, Volume) and len(volume.blocks) * BYTES_OF_BLOCK > gigabytes * 1e9:
        what = f"the volume has grown beyond {gigabytes:g} GB with voxels of {volume.voxel:g}"
        remedy = "the same command goes on with more --memory; or begin anew with larger voxels"
        raise UserError(what, "--memory", f"{remedy} and --overwrite")


def _made(sums: Mapping[str, Sums], sizes: Sizes) -> tuple[dict[str, Any], dict[str, int]]:
    """What the sums show, and how much of it there is."""
    counts: dict[str, int] = {}
    made: dict[str, Any] = {}
    for kind, added in sums.items():
        if isinstance(added, Cloud):
            made[kind] = added.points()
            counts["points"] = len(made[kind].points)
        elif isinstance(added, Volume):
            made[kind] = without_small_parts(surface(added), SMALL_PART * sizes.voxel**2)
            counts["vertices"], counts["faces"] = len(made[kind].vertices), len(made[kind].faces)
    return made, counts


def _nothing(source: DepthSource, left_out: LeftOut, sizes: Sizes, config: FuseConfig) -> UserError:
    what = f"voxels of {sizes.voxel:g} show no surface of the depth that is left"
    if left_out.used == 0:
        what = "no depth is left: maps do not overlap, or do not agree"
        if left_out.doubtful > left_out.unconfirmed:
            what = f"hardly any depth is sure enough ({source.least_confidence:.2g} or more)"
    return UserError(what, source.capture.path, cure(left_out, sizes, config))
