"""Where up is in a world: photos are taken upright, whatever axes the world has."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.upright import up_of, y_up_from_world

PITCHES = (-45.0, 0.0, 30.0)


def held(pitch: float, yaws: FloatArray, world: FloatArray) -> Capture:
    """Cameras held level, turned about up by ``yaws`` and raised by ``pitch``, degrees.

    Args:
        pitch: of all.
        yaws: one for each camera.
        world: ``(3, 3)`` that turns a world whose y is down to another one.
    """
    angles = np.stack([yaws, np.full_like(yaws, pitch)], axis=-1)
    world_from_cam = world @ Rotation.from_euler("YX", angles, degrees=True).as_matrix()
    poses = np.tile(np.eye(4), (len(yaws), 1, 1))
    poses[:, :3, :3] = world_from_cam.transpose(0, 2, 1)
    capture: Capture = SimpleNamespace(frames=SimpleNamespace(cam_from_world=poses))  # type: ignore[assignment]
    return capture


def degrees_between(a: FloatArray, b: FloatArray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.mark.parametrize("axes", ["xyz", "z up", "y up", "any"])
@pytest.mark.parametrize("pitch", PITCHES)
def test_a_camera_that_goes_around_tells_where_up_is(axes: str, pitch: float) -> None:
    turns = {"xyz": [0, 0, 0], "z up": [-90, 0, 0], "y up": [180, 0, 0], "any": [30, 50, 70]}
    world = Rotation.from_euler("xyz", turns[axes], degrees=True).as_matrix()
    up = up_of(held(pitch, np.arange(0.0, 360, 30), world))
    assert degrees_between(up, world @ (0, -1, 0)) < 1e-5


@pytest.mark.parametrize("pitch", PITCHES)
def test_cameras_on_an_arc_that_all_look_down_do_not_tilt_it(pitch: float) -> None:
    """The mean of their own ups alone would be off by 40 degrees."""
    up = up_of(held(pitch, np.arange(-60.0, 61, 10), np.eye(3)))
    assert degrees_between(up, np.array([0.0, -1, 0])) < 12


def test_how_often_a_camera_is_there_does_not_tilt_up() -> None:
    once, yaws = np.arange(-60.0, 61, 10), np.arange(-60.0, 61, 10).repeat(20)
    assert np.allclose(up_of(held(30.0, once, np.eye(3))), up_of(held(30.0, yaws, np.eye(3))))


def test_cameras_that_look_straight_down_say_nothing() -> None:
    up = up_of(held(-90.0, np.arange(0.0, 360, 30), np.eye(3)))
    assert up.tolist() == [0, -1, 0]


@given(ups=arrays(float, (3,), elements=st.floats(-1, 1)).filter(lambda up: up @ up > 1e-3))
def test_the_turn_is_a_rotation_that_takes_up_to_y(ups: FloatArray) -> None:
    up = ups / np.linalg.norm(ups)
    turn = y_up_from_world(up)
    assert np.allclose(turn @ up, (0, 1, 0), rtol=0, atol=1e-8)
    assert np.allclose(turn @ turn.T, np.eye(3), rtol=0, atol=1e-8)
    assert np.linalg.det(turn) > 0


@pytest.mark.parametrize(
    ("up", "turn"),
    [
        ((0, -1, 0), [[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
        ((0, 1, 0), [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ((0, 0, 1), [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
        ((0, 0, -1), [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
        ((1, 0, 0), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        ((-1, 0, 0), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    ],
)
def test_usual_worlds_are_turned_by_quarters(
    up: tuple[float, ...], turn: list[list[float]]
) -> None:
    assert np.allclose(y_up_from_world(np.array(up)), turn, rtol=0, atol=1e-12)
    askew = y_up_from_world(np.add(up, (0.02, -0.03, 0.01)))
    assert np.allclose(askew, turn, rtol=0, atol=0.05)  # and not spun
