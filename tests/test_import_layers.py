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
    "homogeneous",
    "pixels",
    "poses",
    "status",
    "views",
    "projection",
    "fundamental",
    "segments",
    "sampling",
    "matching",
    "null_vector",
    "uncertainty",
    "triangulation",
    "rasterize",
    "modules",
]
ALLOWED = {"torch", "kornia", "numpy", "deltas_geom", *sys.stdlib_module_names}


def imports(path: Path) -> set[str]:
    """Every module that a file imports, wherever in the file."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
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
    allowed = ALLOWED | ({"hypothesis"} if path.parent.name == "testing" else set())
    assert {name.split(".")[0] for name in imports(path)} <= allowed


@pytest.mark.parametrize("name", ORDER)
def test_a_file_imports_only_files_above_it(name: str) -> None:
    above = {f"deltas_geom.{other}" for other in ORDER[: ORDER.index(name)]}
    ours = {module for module in imports(PACKAGE / f"{name}.py") if module.startswith("deltas_")}
    assert ours <= above


def test_importing_deltas_geom_is_light() -> None:
    check = (
        "import sys, deltas_geom, deltas_geom.testing\n"
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
