"""Who may import whom."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ABOVE = {
    "deltas_geom": (
        "status checks records numerics cameras epipolar matching triangulation rasterize "
        "diagnosis modules testing"
    ),
    "deltas_nets": (
        "errors extras terminal config captures network check outputs weights_file losses "
        "reference rooms datasets cost agree fuse predict baselines distill evaluate ablations "
        "page view teachers export train commands cli __main__"
    ),
}
ORDER = {package: names.split() for package, names in ABOVE.items()}
"""Folders and files of each package: one imports only those before it."""
STRANGERS = {("network", "captures")}
"""What the order would let import and still may not."""
PLACES = [(package, place) for package, order in ORDER.items() for place in order]
ALLOWED = {"torch", "kornia", "numpy", "deltas_geom", *sys.stdlib_module_names}


def imports(path: Path, *, at_once: bool = False) -> set[str]:
    """Every module that a file imports, wherever in the file; ``at_once``: outside functions."""
    tree = ast.parse(path.read_text())
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    later = {inner for node in functions for inner in ast.walk(node)} if at_once else set()
    return {name for node in ast.walk(tree) if node not in later for name in _named(node)}


def _named(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0 and node.module is not None, "a relative import"
        for alias in node.names:
            # "from deltas_geom.cameras import poses" imports a module, others take a name from one.
            inner = f"{node.module}.{alias.name}"
            yield inner if _file(inner).exists() else node.module


def _file(module: str) -> Path:
    path = ROOT.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@cache
def imported_by_files(package: str) -> dict[str, set[str]]:
    """The package's own modules, and which of its own each imports."""
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[module] = {name for name in imports(path) if name.split(".")[0] == package}
    return found


def place_of(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


@pytest.mark.parametrize("package", ORDER)
def test_every_file_has_its_place_in_the_order(package: str) -> None:
    assert {place_of(module) for module in imported_by_files(package)} - {""} == set(ORDER[package])


@pytest.mark.parametrize(("package", "place"), PLACES, ids=lambda part: part)
def test_a_folder_imports_only_folders_above_it(package: str, place: str) -> None:
    order = ORDER[package]
    allowed = {*order[: order.index(place) + 1], ""} - {b for a, b in STRANGERS if a == place}
    wrong = {
        f"{module} imports {name}"
        for module, names in imported_by_files(package).items()
        for name in names
        if place_of(module) == place and place_of(name) not in allowed
    }
    assert not wrong


@pytest.mark.parametrize("package", ORDER)
def test_no_files_import_each_other_in_a_circle(package: str) -> None:
    files = {module: names for module, names in imported_by_files(package).items() if "." in module}
    TopologicalSorter(files).prepare()  # raises CycleError, which names them


def test_of_the_package_itself_its_folders_take_the_version_alone() -> None:
    taken = {
        alias.name
        for path in (ROOT / "deltas_nets").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module == "deltas_nets"
        for alias in node.names
        if not _file(f"deltas_nets.{alias.name}").exists()
    }
    assert taken == {"__version__"}


@pytest.mark.parametrize("path", sorted((ROOT / "deltas_geom").rglob("*.py")), ids=lambda p: p.stem)
def test_deltas_geom_stands_on_torch_and_kornia_alone(path: Path) -> None:
    testing = path.is_relative_to(ROOT / "deltas_geom" / "testing")
    allowed = ALLOWED | ({"hypothesis", "cv2"} if testing else set())
    assert {name.split(".")[0] for name in imports(path)} <= allowed
    # OpenCV only when asked for: it is in the extra "test".
    assert "cv2" not in {name.split(".")[0] for name in imports(path, at_once=True)}


def test_importing_deltas_geom_is_light() -> None:
    check = (
        "import sys, deltas_geom, deltas_geom.testing, deltas_geom.testing.conformance\n"
        "loaded = {name.split('.')[0] for name in sys.modules}\n"
        "print(*loaded & {'matplotlib', 'skimage', 'hypothesis', 'cv2', 'deltas_nets'})"
    )
    result = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert result.stdout.strip() == ""
