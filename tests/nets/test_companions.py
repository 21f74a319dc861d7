"""Sources that are no anchors: which of them have maps that others hear, and from which views."""

from pathlib import Path

import pytest

from deltas_nets.captures.companions import companions
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.view_sets import ViewSet


@pytest.fixture(scope="module")
def scene(scannet_root: Path) -> Path:
    return scannet_root / "scans" / "scene0000_00"


def test_each_source_that_is_no_anchor_has_a_set_of_named_frames(scene: Path) -> None:
    capture = open_capture(scene)
    found = companions(capture, [ViewSet("1", ("0", "2")), ViewSet("2", ("1",))], working_depth=2.0)
    assert [views.anchor for views in found] == ["0"]
    assert found[0].sources and set(found[0].sources) <= {"1", "2"}


def test_sets_of_all_frames_have_no_companions(scene: Path) -> None:
    capture = open_capture(scene)
    ids = list(capture.frames)
    sets = [ViewSet(id, (ids[n - 1],)) for n, id in enumerate(ids)]
    assert companions(capture, sets) == ()


def test_frames_whose_maps_another_run_makes_have_no_set_here(scene: Path) -> None:
    sets = [ViewSet("1", ("0", "2")), ViewSet("3", ("2",))]
    found = companions(open_capture(scene), sets, working_depth=2.0, elsewhere=("2", "4"))
    assert [views.anchor for views in found] == ["0"]


def test_frames_that_no_set_names_help_no_companion(scene: Path) -> None:
    for far, anchor in (("0", "4"), ("4", "0")):
        sets = [ViewSet(anchor, (far,))]
        found = companions(open_capture(scene), sets, working_depth=2.0)
        assert found == (ViewSet(far, (anchor,)),)


def test_companions_have_no_more_views_than_the_anchors(scene: Path) -> None:
    sets = [ViewSet("0", ("1",)), ViewSet("2", ("3",))]
    found = companions(open_capture(scene), sets, working_depth=2.0)
    assert [(views.anchor, len(views.sources)) for views in found] == [("1", 1), ("3", 1)]
