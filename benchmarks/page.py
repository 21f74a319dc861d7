"""What a page costs: CPU seconds and bytes, for a folder's maps or many times as many.

    python benchmarks/page.py CAPTURE DEPTHS --maps 1000

Its maps are repeated by links, in a capture whose frames are repeated by links, too.
"""

import json
import os
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.outputs.depth_formats import DEPTH_FORMATS
from deltas_nets.page.maps import Maps, open_maps
from deltas_nets.page.write import write_page


@dataclass(frozen=True)
class Benchmark:
    capture: tyro.conf.Positional[Path]
    depths: tyro.conf.Positional[Path]
    maps: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """So many instead of the folder's."""

    def run(self) -> None:
        maps = open_maps(open_capture(self.capture), self.depths)
        with tempfile.TemporaryDirectory() as folder:
            maps = repeated(maps, self.maps or len(maps.ids), Path(folder))
            wall, cpu = time.perf_counter(), time.process_time()
            page = write_page(maps)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(
            f"{page.maps} maps, {page.shown} on the page of {page.size / 1e6:.1f} MB: "
            f"{cpu:.1f} s of CPU ({1000 * cpu / page.maps:.0f} ms a map), {wall:.1f} s by the "
            f"clock, {memory:.2f} GB of memory; load {os.getloadavg()[0]:.1f}"
        )


def repeated(maps: Maps, count: int, out: Path) -> Maps:
    """The same maps again and again, under numbers, in a folder of links."""
    frames, records = [], {}
    names = [f"depth/{{}}.{name}" for name in DEPTH_FORMATS]
    for number in range(count):
        id = maps.ids[number % len(maps.ids)]
        for name in (*names, "confidence/{}.png", "points/{}.ply"):
            file = maps.folder.resolve() / name.format(id)
            link = out / name.format(number)
            link.parent.mkdir(exist_ok=True)
            if file.exists():
                link.symlink_to(file)
        frame = maps.capture.frame(id)
        fields = {key: getattr(frame, key) for key in frame.__dataclass_fields__}
        frames.append(type(frame)(**fields | {"id": str(number)}))
        records[str(number)] = maps.record(id)
    capture = Capture(maps.capture.path, Frames.of(frames, maps.capture.path), lost={})
    ids = tuple(map(str, range(count)))
    summary = {**maps.summary, "frames": records}
    (out / "summary.json").write_text(json.dumps(summary))
    return maps._replace(folder=out, fused=out, capture=capture, ids=ids, summary=summary)


if __name__ == "__main__":
    tyro.cli(Benchmark).run()
