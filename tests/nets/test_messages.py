"""What people see where something is wrong, whole: messages.txt has every line.

After a change of words write it again and read the difference:

    python tests/nets/test_messages.py > tests/nets/messages.txt
"""

import contextlib
import io
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

from small_capture import FAULTS, WRONG_VIEW_SETS, write_capture, write_view_sets

from deltas_nets import cli
from deltas_nets.outputs.folder import prepare_output

GOLDEN = Path(__file__).with_name("messages.txt")

COMMANDS = (
    "dept",
    "depth",
    "depth nowhere --out OUT",
    "depth a-file --out OUT",
    "depth empty --out OUT",
    "depth nest --out OUT",
    "depth CAPTURE",
    "depth CAPTURE --out CAPTURE",
    "depth CAPTURE --out OUT --vews 3",
    "depth CAPTURE --out OUT --views 1",
    "depth CAPTURE --out OUT --shard 3/2",
    "depth CAPTURE --out OUT --size 100",
    "depth CAPTURE --out OUT --size 4 4",
    "depth CAPTURE --out OUT --work-size 4 4",
    "depth CAPTURE --out OUT --depth-range 3 1",
    "depth CAPTURE --out OUT --depth-range 50 1000",
    "depth CAPTURE --out OUT --depth-scale 0",
    "depth CAPTURE --out OUT --min-confidence 2",
    "depth CAPTURE --out OUT --weights nope",
    "depth CAPTURE --out a-file",
    "depth CAPTURE --out filled",
    "depth CAPTURE --out begun",
    "evaluate",
    "evaluate CAPTURE --rooms 2",
    "evaluate CAPTURE --predictions empty",
    "evaluate BLIND",
    "evaluate --rooms 1 --conditions foo",
    "train --steps abc",
    "train --start-step 3",
    "train --out nowhere --resume",
    "calibrate --out weights.bin",
    "export --out network.txt",
    "recipe night --out OUT --effort 0",
)
IMAGES = {
    "cut": lambda file: file.write_bytes(file.read_bytes()[:-400]),
    "gone": lambda file: file.unlink(),
    "of another size": lambda file: file.write_bytes(_image("RGB", (32, 24))),
    "of 16 bits": lambda file: file.write_bytes(_image("I;16", (64, 48))),
}


def lines(folder: Path) -> Iterator[str]:
    """Every case, and below it what the command says of it."""
    write_capture(folder / "CAPTURE")
    write_capture(folder / "BLIND", depth_size=None)
    (folder / "a-file").write_text("")
    (folder / "nest" / "scans").mkdir(parents=True)
    for name in ("empty", "filled"):
        (folder / name).mkdir()
    (folder / "filled" / "notes.txt").write_text("mine")
    prepare_output(folder / "begun", settings={"views": 3})
    for command in COMMANDS:
        yield from _case(folder, f"deltas {command}", command)
    for name, (break_it, _) in FAULTS.items():
        capture = write_capture(folder / f"with {name}" / "capture")
        break_it(capture)
        yield from _case(folder, name, "depth", capture, "--out", folder / "OUT")
    for name, damage in IMAGES.items():
        capture = write_capture(folder / f"image {name}" / "capture")
        sets = write_view_sets(capture, [{"anchor": 0, "sources": [1]}])
        damage(capture / "color" / "1.jpg")
        command = ["depth", capture, "--out", folder / "OUT", "--view-sets", sets]
        yield from _case(folder, f"image {name}", *command)
    for content in WRONG_VIEW_SETS:
        sets = write_view_sets(folder, content)
        command = ["depth", folder / "CAPTURE", "--out", folder / "OUT", "--view-sets", sets]
        yield from _case(folder, f"view sets {content}", *command)
    assert not (folder / "OUT").exists()


def _case(folder: Path, name: str, *command: object) -> Iterator[str]:
    words = [str(word) for word in command]
    if len(words) == 1:
        words = words[0].split()
        names = {path.name for path in folder.iterdir()} | {"OUT", "nowhere"}
        words = [str(folder / word) if word in names else word for word in words]
    said = io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["deltas", *words]),
        contextlib.redirect_stderr(said),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.suppress(SystemExit),
    ):
        cli.main()
    yield name
    yield from (f"    {line}" for line in said.getvalue().replace(str(folder), "DIR").splitlines())


def _image(mode: str, size: tuple[int, int]) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.new(mode, size).save(file, format="PNG")
    return file.getvalue()


def test_messages_are_those_that_were_read_through(tmp_path: Path) -> None:
    assert list(lines(tmp_path)) == GOLDEN.read_text(encoding="utf-8").splitlines()


def test_every_message_is_a_line_of_what_where_and_remedy() -> None:
    told = GOLDEN.read_text(encoding="utf-8").splitlines()
    for case, line in zip(told[::2], told[1::2], strict=True):
        assert not case.startswith(" ") and line.startswith("    deltas: "), case
        assert ", " in line and ": " in line.removeprefix("    deltas: "), line


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        print(*lines(Path(folder)), sep="\n")
