"""docs/results.md: made of stored records, and of commands that a reader can give."""

import re
import shlex
from pathlib import Path
from types import ModuleType

import pytest

from deltas_nets.cli import COMMANDS
from deltas_nets.commands.command_line import parse

ROOT = Path(__file__).parents[2]


@pytest.fixture
def results(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The program that writes the page."""
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import results

    return results


def test_the_page_is_what_its_records_make(results: ModuleType) -> None:
    written = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert written == "\n".join(results.page()) + "\n"


def test_every_table_and_figure_of_the_paper_leads_somewhere(results: ModuleType) -> None:
    page = "\n".join(results.page())
    headings = re.findall(r"^## (.*)$", page, flags=re.MULTILINE)
    places = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in headings}
    targets = re.findall(r"\]\(([^)]+)\)", page)
    assert len([target for target in targets if target.startswith("#")]) > 15
    for target in targets:
        if target.startswith("#"):
            assert target[1:] in places, target
        else:
            assert (ROOT / "docs" / target).exists(), target


def test_no_figure_is_no_number(results: ModuleType) -> None:
    assert re.findall(r"\b(nan|inf|None)\b", "\n".join(results.page())) == []


def test_every_command_is_one_that_deltas_takes(results: ModuleType) -> None:
    commands = [command for part in results.parts() for command in part.commands]
    programs = [words[1] for words in commands if words[0] == "python"]
    assert programs and all((ROOT / program).exists() for program in programs)
    of_deltas = [words[1:] for words in commands if words[0] == "deltas"]
    assert len(of_deltas) > 30
    for words in of_deltas:
        assert parse(list(words), COMMANDS).__class__.__name__.lower() == words[0]


def test_a_command_beside_a_table_is_the_one_that_is_run(results: ModuleType) -> None:
    run = {shlex.join(words) for part in results.parts() for words in part.commands}
    shown = set(
        re.findall(r"^`((?:deltas|python) [^`]*captures/[^`]*)`$", "\n".join(results.page()), re.M)
    )
    unknown = {command for command in shown - run if "captures/weights" not in command}
    assert shown and unknown == set()


def test_parts_are_measured_again_where_what_decides_them_changed(
    results: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("STATE", "TIMES"):
        monkeypatch.setattr(results, name, tmp_path / f"{name}.json")
    part = results.Part("a", (("deltas", "cost"),), 1)
    key = results.key_of(part, "code")
    known = results.State()
    assert not known.begun(part, key)
    known.note(part, key=key)
    assert known.begun(part, key) and not known.done(part, key)
    known.note(part, key=key, seconds=3.0)
    assert results.State().done(part, key)
    other = results.Part("a", (("deltas", "cost", "--views", "3"),), 1)
    for changed in (results.key_of(part, "other code"), results.key_of(other, "code")):
        assert not known.done(part, changed)


def test_what_another_run_left_is_removed(results: ModuleType, tmp_path: Path) -> None:
    journal, folder = tmp_path / "points.jsonl", tmp_path / "maps"
    journal.write_text("{}")
    (folder / "depth").mkdir(parents=True)
    results.clear(results.Part("a", (), 1, clears=(journal, folder, tmp_path / "none")))
    assert list(tmp_path.iterdir()) == []
