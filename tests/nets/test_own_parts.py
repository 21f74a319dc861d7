"""Mistakes in a part of one's own, as CONTRIBUTING.md says to add them, are told where they are."""

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, cast, get_args, get_type_hints

import numpy as np
import pytest
import torch
from test_encoders import Tiny
from torch import Tensor

from deltas_nets.captures.frame import Frame
from deltas_nets.captures.saving import WRITERS
from deltas_nets.commands.command import Command
from deltas_nets.commands.command_line import parse
from deltas_nets.commands.convert import Convert
from deltas_nets.commands.depth import Depth
from deltas_nets.config.lookup import look_up
from deltas_nets.losses import losses
from deltas_nets.losses.seen import Seen
from deltas_nets.network.features import Channels
from deltas_nets.outputs.depth_formats import DEPTH_FORMATS
from deltas_nets.predict.depth_map import DepthMap, KeypointDepths, PredictConfig, Wanted
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.reach import Reach
from deltas_nets.predict.views_alone import ViewsAlone


@pytest.mark.parametrize(
    ("place", "kind", "told"),
    [
        ("points.match_loss", ValueError, r'names "module:name" in deltas_nets.losses, got'),
        ("nowhere:loss", ModuleNotFoundError, r"there is no deltas_nets.losses.nowhere, which"),
        ("points:mach_loss", AttributeError, r"'points:mach_loss' names: did you mean match_loss"),
        ("points:xyz", AttributeError, r"points has no xyz, .* define it, or mend the row"),
    ],
)
def test_a_row_that_names_nothing_is_told(place: str, kind: type[Exception], told: str) -> None:
    with pytest.raises(kind, match=told):
        look_up("deltas_nets.losses", place)


def test_what_a_file_of_ones_own_misses_is_told_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_package_of_losses").mkdir()
    (tmp_path / "own_package_of_losses" / "mine.py").write_text("import no_such_package\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match=r"^No module named 'no_such_package'$"):
        look_up("own_package_of_losses", "mine:loss")


@pytest.mark.parametrize(
    ("returned", "got"), [(torch.ones(2, 3), r"shape \(2, 3\)"), (1.0, "float"), (None, "NoneType")]
)
def test_a_loss_that_returns_no_scalar_is_told(
    returned: object, got: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(losses, "loss_functions", lambda: {"match": lambda seen: returned})
    told = rf"the loss match \(points:match_loss\) must return a scalar tensor, got {got}"
    with pytest.raises(TypeError, match=told):
        losses._term("match", cast(Seen, None))


class Stated(Tiny):
    """An encoder whose taps are changed."""

    channels = Channels(4, 4, 5, 6, 7)
    change: ClassVar[Callable[[list[Tensor]], list[Tensor]]]

    def taps(self, images: Tensor) -> list[Tensor]:
        return type(self).change(super().taps(images))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda maps: maps[:3], r"Stated.taps must give 4 maps, at 1/2 to 1/16, got 3"),
        (
            lambda maps: [*maps[:3], maps[3][:, :5]],
            r"the map sixteenth \(C, H, W\) \(5, 2, 3\) instead of \(7, 2, 3\)",
        ),
        (
            lambda maps: [maps[0][..., 1:], *maps[1:]],
            r"the map half \(C, H, W\) \(4, 16, 23\) instead of \(4, 16, 24\)",
        ),
    ],
)
def test_maps_of_an_encoder_that_are_not_as_it_states_are_told(
    change: Callable[[list[Tensor]], list[Tensor]], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stated, "change", staticmethod(change), raising=False)
    with pytest.raises(ValueError, match=told):
        Stated()(torch.rand(1, 2, 3, 32, 48))


@pytest.mark.parametrize("size", [(33, 47), (17, 16)])
def test_maps_of_odd_sizes_are_rounded_up(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stated, "change", staticmethod(lambda maps: maps), raising=False)
    height, width = size
    found = Stated()(torch.rand(1, 1, 3, *size))
    assert found.sixteenth.shape == (1, 1, 7, -(-height // 16), -(-width // 16))


@pytest.mark.parametrize(
    ("command", "flag", "table"),
    [(Convert, "to", WRITERS), (Depth, "format", DEPTH_FORMATS)],
)
def test_every_row_can_be_asked_for(
    command: type[Any], flag: str, table: dict[str, object]
) -> None:
    assert get_args(get_type_hints(command)[flag]) == tuple(table)


class Mine(ViewsAlone):
    """A network that gives what it is told to."""

    def __init__(self, given: object) -> None:
        self.given = given

    def depth_map(self, wanted: Wanted) -> object:
        return self.given


def map_of(depth: Any) -> DepthMap:
    none = KeypointDepths.of(torch.zeros(1, 4, 6))
    return DepthMap(depth, None, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (None, "must return a DepthMap, got NoneType"),
        (np.ones((4, 6), np.float32), "must return a DepthMap, got ndarray"),
        (map_of(torch.ones(4, 6)), r"depth as an ndarray \(4, 6\), got Tensor \(4, 6\)"),
        (map_of(np.ones((1, 4, 6))), r"depth as an ndarray \(4, 6\), got ndarray \(1, 4, 6\)"),
    ],
)
def test_what_a_network_gives_in_place_of_a_map_is_told(given: object, told: str) -> None:
    frame = Frame("0", Path("0.jpg"), (4, 6), np.eye(3), np.eye(4))
    with pytest.raises(TypeError, match=f"Mine.depth_map must .*{told.removeprefix('must ')}"):
        look(cast(Predictor, Mine(given)), [frame], PredictConfig(), Reach(0.5, 10.0))


class Plain(Command):
    """A command that was not made a dataclass."""


def test_a_command_that_is_no_dataclass_is_told() -> None:
    with pytest.raises(TypeError, match="Plain in COMMANDS is no dataclass: put @dataclass"):
        parse(["plain"], [Plain])


def test_the_package_runs_as_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["deltas_nets", "--version"])
    runpy.run_module("deltas_nets", run_name="__main__")
    assert capsys.readouterr().out.startswith("deltas-depth ")
