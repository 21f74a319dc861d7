"""Every notebook runs, ends in an assert, and is stored with clean outputs."""

import ast
import json
import re
import sys
from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))
PER_CELL = 60  # s
LARGEST = 1.5e6  # bytes: a notebook is cloned with the code
MACHINE_PATH = re.compile(
    r"/(home|Users|root|tmp|work|mnt|opt|usr|var)/|[A-Z]:\\{1,2}\w|site-packages"
)

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path: Path) -> nbformat.NotebookNode:
    return nbformat.read(path, as_version=4)


def code_cells(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]


def without_magics(source: str) -> str:
    return "\n".join("" if line.startswith(("%", "!")) else line for line in source.split("\n"))


@pytest.fixture
def this_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel named python3 that is the interpreter of the tests, whatever else is installed."""
    kernel = tmp_path / "jupyter" / "kernels" / "python3"
    kernel.mkdir(parents=True)
    command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec = {"argv": command, "display_name": "Python 3", "language": "python"}
    (kernel / "kernel.json").write_text(json.dumps(spec))
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path / "jupyter"))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))  # no profile of the user's
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def test_there_are_notebooks() -> None:
    assert NOTEBOOKS


@each_notebook
@pytest.mark.usefixtures("this_python")
def test_a_notebook_runs(path: Path, tmp_path: Path) -> None:
    stored = path.read_bytes()
    notebook = read(path)
    probe = nbformat.v4.new_code_cell("import sys\nsys.executable")
    notebook.cells.append(probe)
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    client = nbclient.NotebookClient(
        notebook,
        timeout=PER_CELL,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
    )
    client.execute()  # raises CellExecutionError with the cell and its traceback
    assert ast.literal_eval(probe.outputs[0].data["text/plain"]) == sys.executable
    assert path.read_bytes() == stored
    assert list(folder.iterdir()) == [], "a notebook leaves nothing behind"


@each_notebook
def test_a_notebook_ends_in_an_assert(path: Path) -> None:
    last = ast.parse(without_magics(code_cells(read(path))[-1].source)).body[-1]
    assert isinstance(last, ast.Assert)


@each_notebook
def test_the_stored_outputs_are_whole_and_clean(path: Path) -> None:
    cells = code_cells(read(path))
    counts = [cell.execution_count for cell in cells]
    assert counts == list(range(1, len(cells) + 1)), "run all cells in order, then save"
    outputs = [output for cell in cells for output in cell.outputs]
    assert any(output.output_type == "display_data" for output in outputs), "no picture is stored"
    for output in outputs:
        assert output.output_type != "error", output.get("evalue")
        assert output.get("name") != "stderr", f"a warning is stored: {output.get('text')}"


@each_notebook
def test_a_notebook_is_the_same_on_every_machine(path: Path) -> None:
    notebook = read(path)
    nbformat.validate(notebook)
    assert path.stat().st_size < LARGEST
    assert notebook.metadata.kernelspec.name == "python3"
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    texts = [cell.source for cell in notebook.cells]
    for output in (output for cell in code_cells(notebook) for output in cell.outputs):
        texts.append(output.get("text", ""))
        texts += [str(v) for kind, v in output.get("data", {}).items() if kind.startswith("text/")]
    found = [match.group() for text in texts if (match := MACHINE_PATH.search(text))]
    assert not found, f"machine paths: {found}"
