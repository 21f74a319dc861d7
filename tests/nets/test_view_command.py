"""The viewer: what a browser gets to see of a capture and its maps."""

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import changed, chromium, picture_of
from conftest import MakeCapture
from run_command import Run, assert_one_line
from small_capture import write_capture
from small_maps import write_maps

from deltas_nets.captures.opening import open_capture
from deltas_nets.page.maps import open_maps
from deltas_nets.view import viewer

PATIENCE = 20.0  # seconds, for a browser without a graphics card


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile"), size=(800, 500)) as opened:
        yield opened


def test_without_viser_the_extra_is_named(
    run: Run, make_capture: MakeCapture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert_one_line(run("view", make_capture()), "viser", "deltas-depth[view]")


def test_the_command_serves_until_it_is_stopped(
    run: Run, make_capture: MakeCapture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    viser = pytest.importorskip("viser")
    asked = []

    def stopped(server: Any) -> None:
        asked.append(server.get_port())
        raise KeyboardInterrupt

    monkeypatch.setattr(viser.ViserServer, "sleep_forever", stopped)
    capture = make_capture()
    result = run("view", capture, "--port", 18231)
    assert result.code == 0 and not result.err
    assert result.out == f"look at http://127.0.0.1:{asked[0]}; Ctrl-C ends it\n"
    assert_one_line(run("view", capture, "--port", 0), "--port 0")
    # An address that is kept for examples (RFC 5737), and a name of none.
    for host in ("192.0.2.1", "nowhere.invalid"):
        assert_one_line(run("view", capture, "--host", host), "no such address", host)
    assert_one_line(run("view", capture, tmp_path / "nowhere"), "run it first")


def _until(browser: Any, condition: Any) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, browser.page_source[:500]
        time.sleep(0.2)


def test_a_browser_shows_points_that_are_sure_enough(
    browser: Any, tmp_path_factory: pytest.TempPathFactory
) -> None:
    pytest.importorskip("viser")
    root = tmp_path_factory.mktemp("view")
    maps = write_maps(write_capture(root / "a capture"), root / "maps")
    capture = open_capture(root / "a capture")
    server = viewer.open_viewer(capture, open_maps(capture, maps), port=18232)
    try:
        browser.get(f"http://127.0.0.1:{server.get_port()}")
        _until(browser, lambda: "least confidence" in browser.page_source)
        said = browser.find_element("css selector", "body").text
        assert "a capture" in said and "4 frames, 4 maps" in said

        def drawn() -> np.ndarray:
            # Left of the switches, below a notice, beside the axes.
            return picture_of(browser, "canvas")[160:, 60:480]

        empty = np.full_like(drawn(), 255)
        _until(browser, lambda: changed(drawn(), empty) > 0.02)
        full = drawn()
        (least, *_) = browser.find_elements(
            "css selector", "input[inputmode=decimal], input[type=number]"
        )
        least.send_keys("\ue009a", "\ue000", "1", "\ue007")  # all of it becomes 1
        _until(browser, lambda: changed(drawn(), full) > 0.02)
        box = browser.find_elements("css selector", "input[type=checkbox]")[-1]
        few = drawn()
        browser.execute_script("arguments[0].click()", box)
        _until(browser, lambda: changed(drawn(), few) > 0.001)
        assert changed(drawn(), empty) < 0.001  # neither points nor cameras are left
    finally:
        server.stop()
