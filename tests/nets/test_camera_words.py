"""Intrinsics that a user states, and cameras known by name."""

import numpy as np
import pytest

from deltas_nets.captures.camera_words import Intrinsics, named_camera
from deltas_nets.errors import UserError

STATED = {
    "500 510 320 240": None,
    "500,510;320,240": None,
    "500 510 320 240 .1 .2 .3 .4": ("OPENCV", (0.1, 0.2, 0.3, 0.4)),
    "500 510 320 240 .1 .2 .3 .4 .5": ("FULL_OPENCV", (0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0)),
    "500 510 320 240 1 2 3 4 5 6 7 8": ("FULL_OPENCV", (1, 2, 3, 4, 5, 6, 7, 8)),
    "500 0 320  0 510 240  0 0 1": None,
    "500 510 320 240 0 0 0 0 0": None,
}


@pytest.mark.parametrize("text", STATED)
def test_intrinsics_in_words(text: str) -> None:
    K, lens = Intrinsics.parse(text)
    assert K.tolist() == [[500, 0, 320], [0, 510, 240], [0, 0, 1]]
    assert (lens and tuple(lens)) == STATED[text]


def test_a_matrix_may_be_skewed() -> None:
    assert Intrinsics.parse("500 7 320 0 510 240 0 0 1").K[0].tolist() == [500, 7, 320]


@pytest.mark.parametrize(
    "text",
    ["", "500 nan 320 0 510 240 0 0 1", "1 2 3", "a b c d", "0 1 2 3", "nan 1 1 1", "freiburg4"],
)
def test_what_is_no_camera_is_refused(text: str) -> None:
    with pytest.raises(UserError) as error:
        Intrinsics.parse(text)
    assert error.value.where == "--intrinsics" and "freiburg1" in error.value.remedy


def test_cameras_are_known_by_the_names_of_recordings() -> None:
    for name in ("rgbd_dataset_freiburg1_desk", "fr1", "TUM fr1/desk", "freiburg1"):
        camera = named_camera(name)
        assert camera is not None and np.isclose(camera.K[0, 0], 517.306408)
    assert named_camera("afr1") is None and named_camera("fr12") is None
