"""Numbers with decimal commas are told from other words, wherever a text file has numbers."""

from pathlib import Path

import pytest
from written_captures import WRITERS, make_scene
from written_data_sets import DATA_SETS

from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.captures.text_lines import in_commas
from deltas_nets.errors import UserError

ALL = {**WRITERS, **DATA_SETS}
WITH_POINTS = {
    "TUM RGB-D": "groundtruth.txt",
    "7-Scenes": "*.pose.txt",
    "MVSNet": "*_cam.txt",
    "Strecha": "*.camera",
    "ARKitScenes": "*.pincam",
    "COLMAP cameras": "cameras.txt",
    "COLMAP images": "images.txt",
}


@pytest.mark.parametrize("layout", WITH_POINTS)
def test_the_error_says_that_they_are_commas(layout: str, tmp_path: Path) -> None:
    path = tmp_path / "capture"
    if layout.startswith("COLMAP"):
        capture = open_capture(ALL["ARKitScenes"](tmp_path / "in", make_scene()).path)
        save_capture(capture, path, "colmap")
    else:
        path = ALL[layout](path, make_scene()).path
    for file in path.rglob(WITH_POINTS[layout]):
        lines = file.read_text().splitlines()
        # Names of files keep their points.
        words = [
            " ".join(w if w.endswith(".jpg") else w.replace(".", ",") for w in line.split())
            for line in lines
        ]
        file.write_text("\n".join(words) + "\n")
    with pytest.raises(UserError) as error:
        open_capture(path)
    assert "write 0.5, not 0,5" in error.value.what


def test_lists_between_commas_are_none() -> None:
    assert not in_commas("1,2,3") and not in_commas("1, 2") and not in_commas("a,5 x")
    assert in_commas("1 -0,5 3")
