"""Values that make no sense are told before anything heavy is imported."""

import subprocess
import sys
from pathlib import Path

import pytest
from run_command import Run, assert_one_line
from small_capture import write_capture

BAD = {
    "--depth-range 5 1": "0 < NEAR < FAR",
    "--size 100 3": "32 or more",
    "--work-size 3 100": "32 or more",
    "--views 1": "2 or more",
    "--min-confidence 2": "0 to 1",
    "--scale -1": "positive",
    "--depth-scale 0": "positive",
    "--view-sets nowhere.json": "does not exist",
    "--scale-from nowhere.txt": "does not exist",
    "--intrinsics abc": "'abc'",
    "--intrinsics 500 500 320 240": '"500 500 320 240"',
}


@pytest.mark.parametrize("flags", BAD)
def test_a_value_that_makes_no_sense_is_one_line(flags: str, run: Run, tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "capture", num_frames=2)
    result = run("depth", capture, "--out", tmp_path / "out", *flags.split())
    assert_one_line(result, flags.split()[0])
    assert BAD[flags] in result.err and not (tmp_path / "out").exists()


def test_torch_is_not_imported_to_say_so(tmp_path: Path) -> None:
    code = (
        "import sys; from deltas_nets.commands.depth import Depth; from pathlib import Path\n"
        "from deltas_nets.commands.values import check_values\n"
        "try: check_values(Depth(capture=Path('.'), intrinsics='abc'))\n"
        "except Exception: print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
