"""The README: its Python runs, its commands exist, its two promises are what CI runs."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README, flags=re.DOTALL | re.MULTILINE)
SNIPPETS = [text for language, text in BLOCKS if language == "python"]
COMMANDS = [text for language, text in BLOCKS if not language]


@pytest.mark.parametrize("number", range(len(SNIPPETS)))
def test_the_readmes_python_runs(number: int) -> None:
    exec(compile(SNIPPETS[number], f"README.md snippet {number}", "exec"), {})


def test_there_are_snippets_to_run() -> None:
    assert len(SNIPPETS) >= 2


def test_ci_runs_the_two_commands_word_for_word() -> None:
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    test_command = 'pip install -c constraints.txt ".[test]" && pytest'
    demo_command = "pip install -c constraints.txt . && deltas demo"
    shown = [command.strip() for command in COMMANDS]
    assert test_command in shown
    assert demo_command in shown
    for part in (*test_command.split(" && "), *demo_command.split(" && ")):
        assert part.removeprefix("pip install ") in ci


def test_links_lead_somewhere() -> None:
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            if not target.startswith("http"):
                assert (ROOT / target).exists(), f"{page.name} links to {target}"
