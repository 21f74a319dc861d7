"""A summary is exact whenever a run is ended, by a signal that it hears or by another."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import small_output
from run_command import Run

from deltas_nets.outputs.folder import OutputFolder
from deltas_nets.outputs.prepare import prepare_output

SETTINGS: dict[str, Any] = {"views": 3}
MakeCapture = Callable[..., Path]


def write_frame(folder: OutputFolder, id: str) -> None:
    small_output.write_frame(folder, id, record_of(id))


def record_of(id: str) -> dict[str, Any]:
    return {"status": "ok", "sources": [int(id) + 1, int(id) + 2]}


def frames_of(out: Path) -> dict[str, Any]:
    frames: dict[str, Any] = json.loads((out / "summary.json").read_text())["frames"]
    return frames


def record_files(out: Path) -> list[str]:
    return sorted(path.name for path in out.glob("*.jsonl"))


def test_frames_finished_after_the_last_summary_keep_their_records(tmp_path: Path) -> None:
    killed = prepare_output(tmp_path, settings=SETTINGS)
    write_frame(killed, "1")
    killed.write_summary("running")
    assert record_files(tmp_path) == []
    for id in ("2", "3"):
        write_frame(killed, id)
    assert record_files(tmp_path) == ["summary.records.jsonl"]
    with (tmp_path / "summary.records.jsonl").open("a") as file:
        file.write('["4", {"stat')  # killed in the middle of a line
    (tmp_path / "depth" / "3.png").unlink()  # killed before the last file of a frame
    again = prepare_output(tmp_path, settings=SETTINGS)
    assert frames_of(tmp_path) == {"1": record_of("1"), "2": record_of("2")}
    assert record_files(tmp_path) == []
    write_frame(again, "3")
    again.write_summary("complete")
    assert frames_of(tmp_path) == {id: record_of(id) for id in ("1", "2", "3")}
    assert record_files(tmp_path) == []


def test_records_survive_a_second_kill(tmp_path: Path) -> None:
    write_frame(prepare_output(tmp_path, settings=SETTINGS), "1")
    with (tmp_path / "summary.records.jsonl").open("a") as file:
        file.write('["2", {"stat')
    write_frame(prepare_output(tmp_path, settings=SETTINGS), "2")
    prepare_output(tmp_path, settings=SETTINGS).write_summary("complete")
    assert frames_of(tmp_path) == {"1": record_of("1"), "2": record_of("2")}


def test_shards_take_over_their_own_and_one_run_takes_all(tmp_path: Path) -> None:
    for index in (1, 2):
        shard = prepare_output(
            tmp_path, settings=SETTINGS, shard=(index, 2), frame_ids=[str(index)]
        )
        write_frame(shard, str(index))
    again = prepare_output(tmp_path, settings=SETTINGS, shard=(1, 2), frame_ids=["1"])
    assert record_files(tmp_path) == ["summary.2-of-2.records.jsonl"]
    again.write_summary("complete")
    assert frames_of(tmp_path) == {"1": record_of("1")}
    prepare_output(tmp_path, settings=SETTINGS).write_summary("complete")
    assert frames_of(tmp_path) == {"1": record_of("1"), "2": record_of("2")}
    assert record_files(tmp_path) == []


def test_overwriting_forgets_the_records(tmp_path: Path) -> None:
    write_frame(prepare_output(tmp_path, settings=SETTINGS, frame_ids=["1"]), "1")
    prepare_output(tmp_path, settings={"views": 2}, overwrite=True, frame_ids=["1"])
    assert frames_of(tmp_path) == {} and record_files(tmp_path) == []


def test_sigterm_stops_a_run_as_ctrl_c_does(
    run: Run, make_capture: MakeCapture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finished, calls = OutputFolder.write_frame, []

    def killed_at_the_third(*arguments: Any, **more: Any) -> None:
        calls.append(1)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        finished(*arguments, **more)

    handler = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(OutputFolder, "write_frame", killed_at_the_third)
    out = tmp_path / "out"
    stopped = run("depth", make_capture(), "--out", out, "--views", 2, "--workers", 1)
    assert (stopped.code, stopped.err) == (130, "deltas: stopped; the same command goes on\n")
    assert json.loads((out / "summary.json").read_text())["status"] == "stopped"
    assert all(len(frame["sources"]) == 1 for frame in frames_of(out).values())
    assert len(frames_of(out)) == 2
    assert signal.getsignal(signal.SIGTERM) is handler
