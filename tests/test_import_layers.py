"""Who may import whom."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import deltas_geom

PACKAGE = Path(deltas_geom.__file__).parent
ORDER = [
    "checks",
    "precision",
    "homogeneous",
    "pixels",
    "poses",
    "status",
    "triangulated",
    "views",
    "projection",
    "fundamental",
    "segments",
    "sampling",
    "recompute",
    "correlation",
    "matching",
    "chunks",
    "ldl",
    "proof",
    "null_vector",
    "observations",
    "normal_matrix",
    "reprojection",
    "uncertainty",
    "rig_frame",
    "equations",
    "triangulation",
    "refine",
    "rays",
    "track_equations",
    "tracks",
    "midpoint",
    "two_view",
    "robust",
    "rasterize",
    "modules",
]
ALLOWED = {"torch", "kornia", "numpy", "deltas_geom", *sys.stdlib_module_names}


def imports(path: Path, *, at_once: bool = False) -> set[str]:
    """Every module that a file imports, wherever in the file; ``at_once``: outside functions."""
    found = set()
    tree = ast.parse(path.read_text())
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    later = {inner for node in functions for inner in ast.walk(node)} if at_once else set()
    for node in ast.walk(tree):
        if node in later:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            assert node.module is not None
            # "from deltas_geom import poses" imports the module poses too.
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            known = {f"deltas_geom.{name}" for name in ORDER}
            found |= {node.module} | (inside & known)
    return found


def test_every_file_has_its_place_in_the_order() -> None:
    files = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert files == set(ORDER)


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: path.stem)
def test_deltas_geom_stands_on_torch_and_kornia_alone(path: Path) -> None:
    testing = path.parent.name == "testing"
    allowed = ALLOWED | ({"hypothesis", "cv2"} if testing else set())
    assert {name.split(".")[0] for name in imports(path)} <= allowed
    # OpenCV only when asked for: it is in the extra "test".
    assert "cv2" not in {name.split(".")[0] for name in imports(path, at_once=True)}


@pytest.mark.parametrize("name", ORDER)
def test_a_file_imports_only_files_above_it(name: str) -> None:
    above = {f"deltas_geom.{other}" for other in ORDER[: ORDER.index(name)]}
    ours = {module for module in imports(PACKAGE / f"{name}.py") if module.startswith("deltas_")}
    assert ours <= above


def test_importing_deltas_geom_is_light() -> None:
    check = (
        "import sys, deltas_geom, deltas_geom.testing, deltas_geom.testing.conformance\n"
        "loaded = {name.split('.')[0] for name in sys.modules}\n"
        "print(*loaded & {'matplotlib', 'skimage', 'hypothesis', 'cv2', 'deltas_nets'})"
    )
    result = subprocess.run(
        [sys.executable, "-c", check],
        capture_output=True,
        text=True,
        check=True,
        cwd=PACKAGE.parent,
    )
    assert result.stdout.strip() == ""
