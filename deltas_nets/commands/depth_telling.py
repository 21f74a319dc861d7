"""What `deltas depth` says and shows at its end."""

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

from deltas_nets.errors import UserError
from deltas_nets.terminal import counted, progress, warn

if TYPE_CHECKING:
    from deltas_nets.captures.capture import Capture
    from deltas_nets.outputs.folder import OutputFolder
    from deltas_nets.outputs.products import OutputOptions
    from deltas_nets.predict.capture import Outcome


def tell(outcome: "Outcome", folder: "OutputFolder", options: "OutputOptions", format: str) -> None:
    """What became of it all, in a few lines."""
    from deltas_nets.outputs.summary import SUMMARY, read_summary

    kept = f", {outcome.kept} kept from an earlier run" if outcome.kept else ""
    print(f"{counted(outcome.written, 'depth map')} in {folder.path}{kept}")
    if options.unit != "metre":
        steps = f", {options.depth_scale:g} steps of a PNG in it" if format == "png" else ""
        print(f"depth is in {options.unit}{steps}; --scale METRES makes it metric")
    if not options.confidence:
        print("no confidence is written: what --weights names states none")
    if outcome.blind:
        maps = counted(outcome.blind, "map")
        warn(f"a guess where no point was triangulated: {maps}, see summary.json")
    if outcome.piled:
        maps = counted(outcome.piled, "map")
        warn(
            f"points of {maps} pile up at an end of the depth that was searched: is --depth-range "
            "too narrow, or a pose wrong? See summary.json"
        )
    empty = sum("empty" in record for record in folder.frames.values())
    if empty:
        settings = (read_summary(folder.path / SUMMARY) or {}).get("settings", {})
        least = settings.get("predict", {}).get("min_confidence", 0)
        why = (
            f": no pixel is as sure as --min-confidence {least:g}"
            if least
            else ", see summary.json"
        )
        warn(f"{counted(empty, 'map')} without any depth{why}")
    saturated = sum("saturated_pixels" in record for record in folder.frames.values())
    if saturated:
        most = f"{options.max_depth:g} {'m' if options.unit == 'metre' else 'units'}"
        warn(
            f"depth beyond {most} is written as {most} in {counted(saturated, 'map')}: add "
            f"--depth-scale {options.depth_scale / 10:g} or --format npz; see summary.json"
        )
    if outcome.verdict is not None:
        (warn if outcome.verdict.doubtful else print)(outcome.verdict.line)
    waiting = (read_summary(folder.path / SUMMARY) or {}).get("waiting_for", ())
    if waiting:
        print(f"the folder is complete after --shard {', '.join(waiting)}")


def show(capture: "Capture", out: Path, depth_range: tuple[float, float]) -> None:
    """Write the page; maps are worth more, so what hinders it is only a warning."""
    from deltas_nets.outputs.summary import SUMMARY, read_summary

    if (read_summary(out / SUMMARY) or {}).get("status") != "complete":
        return  # another shard does it
    try:
        _write(capture, out, depth_range)
    except UserError as error:
        command = _page_command(capture, out)
        warn(f"no page to look at is written: {error}; {command} goes on from there")


def show_fused(capture: "Capture", depths: Path, fused: Path) -> None:
    """Write the page of a folder of maps anew, if there is one, with what was fused of them.

    Meshes are worth more: what hinders it is only a warning.
    """
    from deltas_nets.outputs.beside import range_of_page
    from deltas_nets.page.maps import has_fused

    depth_range = range_of_page(depths)
    if depth_range is None or not has_fused(fused):
        return
    try:
        _write(capture, depths, depth_range, fused)
    except UserError as error:
        command = f"{_page_command(capture, depths)} --fused {quote(str(fused))}"
        warn(f"the page is as it was: {error}; {command} goes on from there")


def _page_command(capture: "Capture", depths: Path) -> str:
    return f"deltas page {quote(str(capture.path))} {quote(str(depths))}"


def _write(
    capture: "Capture", out: Path, depth_range: tuple[float, float], fused: Path | None = None
) -> None:
    from deltas_nets.page.maps import open_maps
    from deltas_nets.page.write import write_page

    maps = open_maps(capture, out, fused)
    with progress("page", len(maps.ids)) as report:
        page = write_page(maps, depth_range=depth_range, report=report)
    print(page.line)
