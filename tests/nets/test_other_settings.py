"""What is said of a run that would go on with other settings."""

from pathlib import Path

import pytest

from deltas_nets.errors import UserError
from deltas_nets.outputs.prepare import prepare_output
from deltas_nets.outputs.products import OutputOptions


def prepare(out: Path, scaled_by: float, cameras: str) -> None:
    prepare_output(
        out,
        settings={"capture": {"cameras": cameras}, "view_sets": [[cameras, []]]},
        overwrite=False,
        shard=(1, 1),
        frame_ids=["0"],
        options=OutputOptions(),
        head={"scaled_by": scaled_by},
    )


@pytest.mark.parametrize(("scale", "named"), [(2.0, True), (1.0, False)])
def test_another_scale_is_named_by_its_flag(tmp_path: Path, scale: float, named: bool) -> None:
    prepare(tmp_path / "out", 1.0, "of before")
    with pytest.raises(UserError, match="other settings") as raised:
        prepare(tmp_path / "out", scale, "of now")
    assert ("--scale or --scale-from was 1, is 2" in raised.value.what) is named
