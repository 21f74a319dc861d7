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

from PIL import Image
from small_capture import FAULTS, WRONG_VIEW_SETS, write_capture, write_view_sets

from deltas_nets import cli
from deltas_nets.outputs.prepare import prepare_output

GOLDEN = Path(__file__).with_name("messages.txt")

COMMANDS = (
    "dept",
    "depth",
    "depth nowhere --out OUT",
    "depth a-file --out OUT",
    "depth empty --out OUT",
    "depth nest --out OUT",
    "depth many --out OUT",
    "depth --views 3",
    "depth CAPTURE --out CAPTURE",
    "depth CAPTURE --out OUT --vews 3",
    "depth CAPTURE --view 3",
    "depth CAPTURE --glb",
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
    "page CAPTURE",
    "page CAPTURE empty",
    "page CAPTURE begun",
    "page nowhere empty",
    "page CAPTURE empty --depth-range 3 1",
    "view CAPTURE empty",
    "view CAPTURE --port 0",
    "view CAPTURE --host 192.0.2.1",
    "evaluate",
    "evaluate CAPTURE --rooms 2",
    "evaluate CAPTURE CAPTURE",
    "evaluate CAPTURE --gap 3",
    "evaluate CAPTURE --protocol paper",
    "evaluate CAPTURE --data scannet --split nowhere.txt",
    "evaluate CAPTURE --scenes nowhere.txt",
    "evaluate CAPTURE --num-points 3",
    "evaluate CAPTURE --offset 2",
    "evaluate CAPTURE --predictions empty",
    "evaluate BLIND",
    "evaluate CAPTURE --depth-range 3 9",
    "evaluate --rooms 1 --conditions foo",
    "evaluate nowhere --json OUT/s.json",
    "detectors",
    "detectors nowhere",
    "detectors CAPTURE --detectors surf",
    "detectors CAPTURE --detectors aliked",
    "detectors CAPTURE --detectors",
    "detectors CAPTURE/color/0.jpg",
    "detectors CAPTURE --num-points 0",
    "detectors BLIND --detectors orb",
    "ablate points CAPTURE",
    "ablate foo CAPTURE --out OUT",
    "ablate offsets CAPTURE --out OUT",
    "ablate points BLIND --out OUT",
    "ablate points CAPTURE --out CAPTURE",
    "ablate points CAPTURE --out OUT --weights",
    "robustness order CAPTURE --out OUT --sets 0",
    "robustness order CAPTURE --out a-file",
    "evaluate CAPTURE --json a-file/s.json",
    "depth CAPTURE --out OUT foo",
    "train --steps abc",
    "train --out OUT --steps 0",
    "train --out OUT --sizes 10 10",
    "train --out OUT --sizes 96 128 96",
    "train --out OUT --network.densifier-widths wide",
    "train --out OUT --learning-rate nan",
    "train --out OUT --learning-rate 0",
    "train --out OUT --data.workers -1",
    "train --out OUT --data.shelf 0",
    "train --out OUT --data.replay 5",
    "train --out OUT --num-keypoints 0",
    "train --out OUT --network.detector.num-keypoints 2",
    "train --out OUT --loss.depth inf",
    "train --out OUT --checkpoint-every 0",
    "train --out OUT --start-step -1",
    "train --out OUT --init deltas-large",
    "train --out OUT --data scannet --encoder none",
    "train --out OUT --data scannet --root nowhere --encoder none",
    "train --out OUT --data scannet --root empty --encoder none",
    "train --out OUT --data scannet --root CAPTURE --encoder none",
    "train --out OUT --data scannet --root CAPTURE --encoder none --data.split a-file",
    "train --out OUT --data scannet --root CAPTURE --encoder none --data.split words",
    "train --out OUT --data scannet --root CAPTURE --encoder none --data.split other",
    "train --out OUT --data scannet --root CAPTURE --encoder none --data.split none.txt",
    "train --out a-file",
    "train --out a-file/run",
    "train --start-step 3",
    "train --out nowhere --resume",
    "calibrate --out weights.bin",
    "export --out network.txt",
    "export --out OUT.onnx --weights plane-sweep",
    "export --out OUT.onnx --size 32 32 --points 2000",
    "recipe night --out OUT --effort 0",
)


def image(mode: str, size: tuple[int, int]) -> bytes:
    file = io.BytesIO()
    Image.new(mode, size).save(file, format="PNG")
    return file.getvalue()


FILES: dict[str, tuple[str, bytes | int]] = {
    "a cut JPEG": ("color/1.jpg", -400),
    "an empty image": ("color/1.jpg", 0),
    "an image of another size": ("color/1.jpg", image("RGB", (32, 24))),
    "an image of 16 bits": ("color/1.jpg", image("I;16", (64, 48))),
    "a cut depth": ("depth/1.png", -40),
    "depth of another size": ("depth/1.png", image("I;16", (32, 24))),
    "depth of 8 bits": ("depth/1.png", image("L", (64, 48))),
    "a pose that is lost": ("pose/1.txt", b"nan " * 16),
}
"""Of a frame that a view set names: what the file holds, or how much of it is left."""


def lines(folder: Path) -> Iterator[str]:
    """Every case, and below it what the command says of it."""
    write_capture(folder / "CAPTURE")
    write_capture(folder / "BLIND", depth_size=None)
    (folder / "a-file").write_text("")
    (folder / "nest" / "scans").mkdir(parents=True)
    for name in ("empty", "filled"):
        (folder / name).mkdir()
    (folder / "filled" / "notes.txt").write_text("mine")
    (folder / "words").write_text("two words")
    (folder / "other").write_text("scene0009_00")
    for name in ("one", "two"):
        write_capture(folder / "many" / "scans" / name, num_frames=2)
    prepare_output(folder / "begun", settings={"views": 3})
    for command in COMMANDS:
        yield from _case(folder, f"deltas {command}", command)
    for name, break_it in FAULTS.items():
        capture = write_capture(folder / f"with {name}" / "capture")
        break_it(capture)
        yield from _case(folder, name, "depth", capture, "--out", folder / "OUT")
    for name, (file, content) in FILES.items():
        capture = write_capture(folder / name)
        whole = (capture / file).read_bytes()
        (capture / file).write_bytes(whole[:content] if isinstance(content, int) else content)
        sets = write_view_sets(capture, [{"anchor": 1, "sources": [0]}])
        yield from _case(folder, name, "evaluate", capture, "--view-sets", sets)
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
        words = [str(folder / word) if word.split("/")[0] in names else word for word in words]
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
