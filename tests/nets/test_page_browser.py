"""The page in a browser: opened from disk, without a server, and worked with."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import changed, chromium, picture_of, settled
from small_capture import write_capture
from small_maps import mesh_of, write_maps

from deltas_nets.captures.opening import open_capture
from deltas_nets.page.maps import open_maps
from deltas_nets.page.write import write_page

Do = Callable[..., Any]
MARKUP = "<img src=x onerror=document.title=1>"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps of a capture that is called after markup, and a mesh."""
    root = tmp_path_factory.mktemp("page")
    capture = write_capture(root / MARKUP)
    out = write_maps(capture, root / "maps")
    write_page(open_maps(open_capture(capture), out))
    return out


@pytest.fixture
def page(browser: Any, folder: Path) -> Any:
    """The page, opened anew."""
    browser.get_log("browser")
    browser.get((folder / "index.html").as_uri())
    settled(browser)
    return browser


def actions() -> Any:
    return pytest.importorskip("selenium.webdriver").ActionChains


def set_split(page: Any, share: int) -> None:
    page.execute_script(
        "const split = document.getElementById('split'); split.value = arguments[0];"
        "split.dispatchEvent(new Event('input'))",
        share,
    )


def drag(page: Any, selector: str, right: int, down: int = 0) -> None:
    element = page.find_element("css selector", selector)
    actions()(page).drag_and_drop_by_offset(element, right, down).perform()


def test_it_opens_without_a_network_and_without_complaints(page: Any) -> None:
    assert page.get_log("browser") == []
    messages = [json.loads(line["message"])["message"] for line in page.get_log("performance")]
    asked = [
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
        and message["params"]["documentURL"] == page.current_url  # not the browser's new tab
    ]
    assert asked[0] == page.current_url
    assert {url.partition(":")[0] for url in asked[1:]} <= {"data"}
    # The capture's name is shown, and nothing more.
    assert page.find_element("css selector", "h1").text == MARKUP
    assert page.title == f"{MARKUP}: depth maps"


def test_a_page_of_one_frame_without_depth_opens(browser: Any, tmp_path: Path) -> None:
    out = write_maps(write_capture(tmp_path / "one", 1), tmp_path / "maps", depth=np.zeros)
    write_page(open_maps(open_capture(tmp_path / "one"), out))
    browser.get_log("browser")
    browser.get((out / "index.html").as_uri())
    settled(browser)
    assert browser.get_log("browser") == []
    assert not browser.find_element("id", "next").is_enabled()
    assert picture_of(browser, "#canvas").std() > 1  # its camera
    browser.find_element("id", "from").click()


def test_the_slider_uncovers_depth(page: Any) -> None:
    set_split(page, 100)
    image = picture_of(page, "#under")
    set_split(page, 0)
    depth = picture_of(page, "#under")
    assert changed(image, depth) > 0.8
    width = depth.shape[1]
    red, _, blue = depth[:, width // 20].mean(axis=0)
    assert red > blue + 50  # near is red
    red, _, blue = depth[:, -width // 20].mean(axis=0)
    assert blue > red
    set_split(page, 50)
    both, edge = picture_of(page, "#under"), width // 25
    left, right = slice(0, width // 2 - edge), slice(width // 2 + edge, None)
    assert changed(both[:, left], image[:, left]) < 0.01
    assert changed(both[:, right], depth[:, right]) < 0.01
    drag(page, "#wipe", width // 4)
    assert changed(picture_of(page, "#under")[:, left], image[:, left]) < 0.01
    assert int(page.find_element("id", "split").get_attribute("value")) == pytest.approx(75, abs=2)


def test_the_scene_is_drawn_and_turns_with_a_drag_and_keys(page: Any) -> None:
    first = picture_of(page, "#canvas")
    ground = np.median(first.reshape(-1, 3), axis=0)
    assert (np.abs(first - ground).max(axis=-1) > 30).mean() > 0.05
    drag(page, "#canvas", 120)
    turned = picture_of(page, "#canvas")
    assert changed(first, turned) > 0.05
    page.find_element("id", "reset").click()
    assert changed(first, picture_of(page, "#canvas")) < 0.01
    page.find_element("id", "canvas").send_keys("\ue012\ue012+")  # twice to the left, and nearer
    assert changed(first, picture_of(page, "#canvas")) > 0.05
    page.find_element("id", "from").click()
    assert changed(turned, picture_of(page, "#canvas")) > 0.05


def test_layers_are_switched_off(page: Any) -> None:
    boxes = page.find_elements("css selector", "#layers input")
    assert page.find_element("id", "layers").text.split("\n") == ["points of the maps", "cameras"]
    for box in boxes:
        box.click()
    assert picture_of(page, "#canvas")[4:-4, 4:-4].std(axis=(0, 1)).max() < 1


def test_a_mesh_is_shown(browser: Any, folder: Path) -> None:
    mesh_of(folder)
    capture = open_capture(folder.parent / MARKUP)
    try:
        write_page(open_maps(capture, folder))
        browser.get((folder / "index.html").as_uri())
        shown = picture_of(browser, "#canvas")
        assert browser.find_element("id", "layers").text.split("\n") == ["mesh", "cameras"]
    finally:
        (folder / "mesh.ply").unlink()
        write_page(open_maps(capture, folder))
    assert (shown.max(axis=-1) > 60).mean() > 0.03


def test_frames_are_walked_through(page: Any) -> None:
    first = picture_of(page, "#under")
    page.find_element("css selector", "body").send_keys("\ue014")  # to the right
    assert page.find_element("id", "id").text == "1"
    assert changed(first, picture_of(page, "#under")) > 0.1
    assert page.find_element("css selector", "[aria-current=true]").get_attribute("title") == "1"
    assert "Frame 2 of 4" in page.find_element("id", "about").text
    page.find_elements("css selector", "#strip button")[3].click()
    assert page.find_element("id", "id").text == "3"
    page.find_element("id", "next").click()
    assert page.find_element("id", "id").text == "0"


def test_pictures_are_chosen_and_read_under_the_pointer(page: Any) -> None:
    panels = page.find_elements("css selector", "#panels button")
    assert [panel.text for panel in panels] == [
        "Image", "Depth", "Confidence", "Error", "Sensor depth",
    ]  # fmt: skip
    set_split(page, 0)
    depth = picture_of(page, "#under")
    panels[4].click()
    assert changed(depth, picture_of(page, "#under")) > 0.5
    assert panels[4].get_attribute("aria-pressed") == "true"
    wipe = page.find_element("id", "wipe")
    actions()(page).move_to_element_with_offset(wipe, wipe.size["width"] // 4, 0).perform()
    settled(page)
    said = page.find_element("id", "reading").text
    read = dict(part.rsplit(" ", 2)[:2] for part in said.split(" · "))
    assert float(read["depth"]) == pytest.approx(2.75, abs=0.06)  # m: a quarter from the right
    assert float(read["sensor depth"]) == pytest.approx(2.5, abs=0.06)
    assert float(read["confidence"]) == pytest.approx(60, abs=2)
    assert float(read["error"]) == pytest.approx(10, abs=1)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_shows_it_in_its_own_colours(page: Any, scheme: str) -> None:
    metrics = {"width": 360, "height": 740, "deviceScaleFactor": 1, "mobile": True}
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    try:
        page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        page.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        settled(page)
        wide = page.execute_script("return document.documentElement.scrollWidth")
        ground = picture_of(page, "header").mean()
        page.find_element("id", "theme").click()
        other = picture_of(page, "header").mean()
    finally:
        page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert wide <= 360
    assert ground > 180 > 80 > other if scheme == "light" else ground < 80 < 180 < other
