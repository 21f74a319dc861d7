"""What a network would say of a frame of four by six pixels, written or to be written."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from deltas_nets.captures.frame import Frame
from deltas_nets.outputs.folder import OutputFolder
from deltas_nets.outputs.products import FrameOutput

DONE = {"status": "done", "seconds": 0.1}


def output_of(id: str, **more: Any) -> FrameOutput:
    """Of a frame without files."""
    return FrameOutput(
        Frame(id, Path(f"{id}.jpg"), (4, 6), np.eye(3), np.eye(4)),
        depth=np.full((4, 6), 2.0),
        confidence=np.full((4, 6), 0.5),
        points=np.zeros((2, 3)),
        colors=np.zeros((2, 3), np.uint8),
    )._replace(**more)


def write_frame(folder: OutputFolder, id: str, record: Mapping[str, Any] = DONE) -> None:
    folder.write_frame(output_of(id), record)


def summary_of(out: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return content
