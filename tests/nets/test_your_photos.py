"""The recipe of docs/your_photos.md: what it yields is what the command writes."""

import re
from pathlib import Path
from typing import Any

import numpy as np

PAGE = Path(__file__).resolve().parents[2] / "docs" / "your_photos.md"


def test_depth_maps_in_python(scannet_root: Path) -> None:
    names: dict[str, Any] = {}
    text = PAGE.read_text(encoding="utf-8")
    for snippet in re.findall(r"^```python\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE):
        exec(compile(snippet, PAGE.name, "exec"), names)
    id, depth, confidence = next(names["depth_maps"](scannet_root / "scans" / "scene0000_00"))
    assert id == "0" and depth.shape == confidence.shape == (96, 128)
    assert np.isfinite(depth).all() and (depth > 0).all()
    assert (confidence >= 0).all() and (confidence <= 1).all()
