"""What a network costs: counts known by hand, torch's own counter, sums over stages."""

import io
import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from rich.console import Console
from torch import Tensor, nn
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from deltas_geom import PosedViews
from deltas_nets.config import CONFIGS, MatcherConfig, NetworkConfig
from deltas_nets.cost import command
from deltas_nets.cost.command import run_cost
from deltas_nets.cost.literature import PAPER_PARTS, PAPER_TOTAL
from deltas_nets.cost.measure import Cost, cost_of, cost_of_run, posed_noise
from deltas_nets.cost.memory import PeakMemory
from deltas_nets.cost.operations import Flops, OperationCounter
from deltas_nets.cost.report import PARTS, comparison_table, cost_table, costs_as_json, gmacs
from deltas_nets.cost.stages import GEOMETRY, followed_stages, parameters_by_stage
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.networks import Network, build_network
from deltas_nets.reference import ReferenceNetwork

SIZE = (96, 128)
CHILDREN = ["encoder", "detector", "descriptor", "matcher", "judge", "densifier"]


def counted(run: Callable[[], object]) -> OperationCounter:
    counter = OperationCounter()
    with torch.no_grad(), counter:
        run()
    return counter


PER_VIEW = NetworkConfig(name="per view", matcher=MatcherConfig(kind="per_view"))


@pytest.fixture(scope="module", params=[*CONFIGS.values(), PER_VIEW], ids=lambda it: it.name)
def model(request: pytest.FixtureRequest) -> Network:
    """Every network there is; what it costs does not depend on its weights."""
    return build_network(request.param).eval()


@pytest.fixture(scope="module")
def small() -> Deltas:
    return Deltas(CONFIGS["deltas-small"]).eval()


@pytest.fixture(scope="module")
def cost(small: Deltas) -> Cost:
    return cost_of(small, 3, SIZE, 64, repeats=1)


# Multiply-accumulates of one layer, by hand: every weight of an output element, once.


@pytest.mark.parametrize(
    ("layer", "shape", "macs"),
    [
        (nn.Conv2d(3, 8, 3, padding=1), (2, 3, 10, 12), 2 * (8 * 120) * (3 * 9)),
        (nn.Conv2d(3, 8, 3, stride=2, bias=False), (1, 3, 11, 11), (8 * 25) * (3 * 9)),
        (nn.Conv2d(8, 12, 3, padding=1, groups=4), (1, 8, 5, 7), (12 * 35) * (2 * 9)),
        (nn.Conv2d(6, 6, 5, padding=2, groups=6), (1, 6, 4, 4), (6 * 16) * 25),
        (nn.Conv1d(2, 5, 5, padding=2), (3, 2, 20), 3 * (5 * 20) * (2 * 5)),
        # Transposed: every input element goes through all the weights of its channel.
        (nn.ConvTranspose2d(4, 6, 4, stride=2, padding=1), (1, 4, 5, 7), (4 * 35) * (6 * 16)),
        (nn.ConvTranspose2d(4, 6, 2, stride=2, groups=2), (1, 4, 5, 7), (4 * 35) * (3 * 4)),
        (nn.Linear(7, 11), (5, 7), 5 * 11 * 7),
        (nn.Linear(7, 11, bias=False), (2, 5, 7), 2 * 5 * 11 * 7),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, nn.Module) else None,
)
def test_a_layer_has_the_known_products(
    layer: nn.Module, shape: tuple[int, ...], macs: int
) -> None:
    assert counted(lambda: layer(torch.rand(shape))).total() == Flops(2 * macs, 2 * macs)


def test_matrix_products_in_all_their_spellings() -> None:
    a, b = torch.rand(4, 3, 5), torch.rand(4, 5, 6)
    products = 2 * 4 * 3 * 5 * 6
    for run in (
        lambda: a @ b,
        lambda: torch.einsum("bij,bjk->bik", a, b),
        lambda: torch.baddbmm(torch.zeros(4, 3, 6), a, b),
    ):
        assert counted(run).total().products == products
    assert counted(lambda: a[0] @ b[0]).total() == Flops(products // 4, products // 4)


def test_fused_attention_counts_as_its_products_and_its_softmax() -> None:
    query, key, value = torch.rand(2, 4, 10, 8), torch.rand(2, 4, 12, 8), torch.rand(2, 4, 12, 8)
    fused = counted(lambda: F.scaled_dot_product_attention(query, key, value))
    apart = counted(lambda: (query @ key.mT).softmax(dim=-1) @ value)
    assert not fused.unknown
    assert fused.total() == apart.total()


# The other operators, by the convention: one multiply-accumulate is two operations.

X = torch.rand(2, 3, 8, 10)


@pytest.mark.parametrize(
    ("run", "flops"),
    [
        (lambda: X + X, 480),
        (lambda: X.clone().add_(1), 480),
        (lambda: X * X[:, :1], 480),
        (lambda: X.exp(), 480),
        (lambda: torch.where(X > 0.5, X, 0.0), 2 * 480),
        (lambda: torch.addcmul(X, X, X), 2 * 480),
        (lambda: X.sum(dim=1), 480),
        (lambda: X.amax(), 480),
        (lambda: X.softmax(dim=1), 5 * 480),
        (lambda: F.avg_pool2d(X, 2), 4 * 120),
        (lambda: F.max_pool2d(X, (2, 5)), 10 * 48),
        (lambda: F.batch_norm(X, torch.zeros(3), torch.ones(3)), 2 * 480),
        (lambda: F.batch_norm(X, None, None, training=True), 8 * 480),
        (lambda: F.grid_sample(X, torch.zeros(2, 4, 5, 2), align_corners=False), 8 * 2 * 3 * 20),
        (lambda: F.grid_sample(X, torch.zeros(2, 4, 5, 2), "nearest", align_corners=False), 0),
        (lambda: F.interpolate(X, size=(16, 20), mode="bilinear"), 8 * 2 * 3 * 320),
        (lambda: F.interpolate(X, size=(16, 20), mode="nearest"), 0),
        (lambda: torch.zeros(3, 5).scatter_add(0, torch.zeros(2, 5).long(), torch.ones(2, 5)), 10),
        (lambda: torch.cdist(torch.rand(4, 2), torch.rand(5, 2)), 20 * 7),
        (lambda: torch.linalg.inv(torch.eye(4).expand(6, 4, 4)), 6 * 2 * 64),
        (lambda: torch.linalg.svd(torch.eye(4)[None]), (4 + 8 + 9) * 64),
        (lambda: X.sort(dim=-1), 4 * 480),
        (lambda: X.flatten().topk(5), 3 * 480),
        (lambda: X.mT.reshape(-1)[3:].unsqueeze(0).expand(2, -1), 0),
        (lambda: torch.cat([F.pad(X, (1, 1)), torch.zeros(2, 3, 8, 12)]).contiguous(), 0),
    ],
)
def test_an_operator_counts_by_the_convention(run: Callable[[], object], flops: int) -> None:
    counter = counted(run)
    assert not counter.unknown
    assert counter.total() == Flops(0, flops)


def test_an_operator_without_a_formula_is_named() -> None:
    assert counted(lambda: torch.special.i0(X) + 1).unknown == {"aten::i0": 1}


def test_inference_mode_counts_the_same() -> None:
    layer = nn.Sequential(nn.Conv2d(3, 8, 3), nn.BatchNorm2d(8), nn.ReLU(inplace=True)).eval()
    with torch.inference_mode(), OperationCounter() as counter:
        layer(X)
    assert not counter.unknown
    assert counter.total() == counted(lambda: layer(X)).total()
    assert counter.total().products > 0


# Stages.


class Toy(nn.Module):
    """A list of layers, a child that calls another, and a product of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.levels = nn.ModuleList([nn.Linear(4, 4), nn.Linear(4, 4)])
        self.inner = nn.Linear(4, 6)
        self.outer = nn.Sequential(self.inner, nn.Linear(6, 2))
        self.weight = nn.Parameter(torch.rand(2, 5))

    def forward(self, x: Tensor) -> Tensor:
        for level in self.levels:
            x = level(x)
        return torch.as_tensor(self.outer(x) @ self.weight)


def test_an_operation_belongs_to_the_innermost_child() -> None:
    model, counter, x = Toy(), OperationCounter(), torch.rand(1, 4)
    entered: list[str] = []
    with torch.no_grad(), followed_stages(model, counter.enter), counter:
        model(x) @ torch.rand(5, 3)
    products = {name: flops.products // 2 for name, flops in counter.flops.items()}
    assert products == {"levels": 32, "inner": 24, "outer": 12, GEOMETRY: 10 + 15}
    with followed_stages(model, entered.append):
        model(x)
    assert entered == [
        GEOMETRY, "levels", GEOMETRY, "levels", GEOMETRY,
        "outer", "inner", "outer", GEOMETRY,
    ]  # fmt: skip
    entered.clear()
    model(x)
    assert not entered, "hooks must be gone"


def test_a_stage_that_is_used_piece_by_piece_is_one_stage() -> None:
    model, counter = Toy(), OperationCounter()
    with torch.no_grad(), followed_stages(model, counter.enter), counter:
        model.outer[1](torch.rand(1, 6))  # its container is not called
    assert {name for name, flops in counter.flops.items() if flops.products} == {"outer"}


def test_after_an_exception_what_follows_is_counted_right() -> None:
    model, entered = Toy(), list[str]()
    with followed_stages(model, entered.append):
        with pytest.raises(RuntimeError):
            model(torch.rand(1, 3))
        assert entered == [GEOMETRY, "levels", GEOMETRY]
        model.inner(torch.rand(1, 4))
    assert entered[3:] == ["inner", GEOMETRY]


def test_a_shared_parameter_is_counted_once() -> None:
    model = Toy()
    found = parameters_by_stage(model)
    assert found == {"levels": 40, "inner": 30, "outer": 14, GEOMETRY: 10}
    assert sum(found.values()) == sum(weight.numel() for weight in model.parameters())


class Sleeper(nn.Module):
    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds = seconds
        self.norm = nn.BatchNorm1d(2)

    def forward(self, x: Tensor) -> Tensor:
        time.sleep(self.seconds)
        return torch.as_tensor(self.norm(x))


def test_time_goes_to_the_stage_that_spends_it() -> None:
    model, x = nn.Sequential(Sleeper(0.03), Sleeper(0.09)), torch.rand(3, 2)

    def run() -> None:
        model(x)
        time.sleep(0.06)

    cost = cost_of_run(model, run, repeats=3)
    assert cost.stages["0"].seconds >= 0.03
    assert cost.stages[GEOMETRY].seconds >= 0.06
    assert cost.stages["1"].seconds >= 0.09
    assert cost.stages["0"].seconds < cost.stages[GEOMETRY].seconds < cost.stages["1"].seconds
    assert cost.total.seconds >= 0.18


def test_what_happens_between_the_children_is_geometry() -> None:
    model, factor = nn.Sequential(nn.Linear(4, 4)), torch.rand(4, 9)
    rows = X.mT.reshape(-1, 4)
    cost = cost_of_run(model, lambda: model(rows) @ factor, repeats=1)
    assert cost.stages["0"].flops.products == 2 * 120 * 16
    assert cost.stages[GEOMETRY].flops.products == 2 * 120 * 36
    assert cost.stages[GEOMETRY].seconds > 0
    with pytest.raises(ValueError, match="repeats"):
        cost_of_run(model, lambda: None, repeats=0)


def test_measuring_leaves_the_network_as_it_was() -> None:
    model = nn.Sequential(Sleeper(0), Sleeper(0)).train()
    model[1].eval()
    cost = cost_of_run(model, lambda: model(torch.rand(3, 2)), repeats=1)
    assert [module.training for module in (model, model[0], model[1])] == [True, True, False]
    assert model.state_dict()["0.norm.num_batches_tracked"] == 0
    assert cost.total.flops.every == 2 * 2 * 6


# The network.


def test_torch_counts_the_same_products(model: Network) -> None:
    images, views = posed_noise(3, image_size=SIZE)
    counter = OperationCounter()
    with torch.no_grad(), FlopCounterMode(display=False) as reference:
        model(images, views, num_keypoints=64)
    with torch.no_grad(), followed_stages(model, counter.enter), counter:
        model(images, views, num_keypoints=64)
    assert counter.total().products == reference.get_total_flops() > 0
    by_module = reference.get_flop_counts()
    for name, _ in model.named_children():
        expected = sum(by_module[f"{type(model).__name__}.{name}"].values())
        assert counter.flops[name].products == expected
    assert not counter.unknown  # every operator has a formula


def test_the_stages_sum_to_the_whole(cost: Cost, small: Deltas) -> None:
    assert list(cost.stages) == [*CHILDREN, GEOMETRY]
    for column in ("products", "every"):
        parts = sum(getattr(stage.flops, column) for stage in cost.stages.values())
        assert parts == getattr(cost.total.flops, column) > 0
    assert cost.total.parameters == sum(weight.numel() for weight in small.parameters())
    assert sum(stage.parameters for stage in cost.stages.values()) == cost.total.parameters
    assert cost.total.seconds == pytest.approx(
        sum(stage.seconds for stage in cost.stages.values())
    )  # of one run
    assert not cost.unknown


def test_all_operations_include_the_products(cost: Cost) -> None:
    for stage in cost.stages.values():
        assert stage.flops.every > stage.flops.products
    # The triangulation is arithmetic on small vectors, not matrix products.
    geometry = cost.stages[GEOMETRY].flops
    assert geometry.every > 5 * geometry.products


def test_four_times_the_area_is_four_times_the_convolutions(small: Deltas, cost: Cost) -> None:
    larger = cost_of(small, 3, (2 * SIZE[0], 2 * SIZE[1]), 64, repeats=1)
    for name in ("encoder", "detector", "descriptor", "densifier"):
        before, after = cost.stages[name].flops.products, larger.stages[name].flops.products
        assert after / before == pytest.approx(4, rel=0.01)
    assert larger.total.parameters == cost.total.parameters


def test_sources_cost_descriptors_but_no_densification(small: Deltas, cost: Cost) -> None:
    fewer = cost_of(small, 2, SIZE, 64, repeats=1).stages
    for name in ("encoder", "descriptor"):
        assert 2 * cost.stages[name].flops.products == 3 * fewer[name].flops.products
    for name in ("detector", "densifier"):
        assert cost.stages[name].flops == fewer[name].flops


# Beside the paper: 16.57, below 0.002 and 67.90, with batch norm and without the correlation.
# 512 points x 300 samples x 128 channels are 0.0197 of the matcher.


@pytest.mark.parametrize(
    ("build", "parts"),
    [
        (ReferenceNetwork, (16.50, 0.021, 67.86)),
        (lambda: Deltas(CONFIGS["deltas-resnet50"]), (15.76, 0.021, 67.86)),
        (lambda: Deltas(CONFIGS["deltas-vgg9"]), (12.73, 0.021, 4.03)),
    ],
    ids=["reference", "deltas-resnet50", "deltas-vgg9"],
)
def test_the_papers_networks_have_the_papers_products(
    build: Callable[[], nn.Module], parts: tuple[float, ...]
) -> None:
    model = build().eval()
    images, views = posed_noise(2, image_size=(240, 320))
    counter = OperationCounter()
    with torch.no_grad(), followed_stages(model, counter.enter), counter:
        model(images, views, num_keypoints=512)
    found = [
        gmacs(sum(counter.flops[name].products for name in names if name in counter.flops))
        for names in PARTS.values()
    ]
    assert sum(found) == pytest.approx(gmacs(counter.total().products)), "a stage is in no part"
    assert found == pytest.approx(parts, abs=0.005)
    assert found[1] == pytest.approx(parts[1], abs=0.0015)


# Memory.


def test_peak_memory_is_what_torchs_allocator_gives(small: Deltas) -> None:
    images, views = posed_noise(2, image_size=SIZE)
    with torch.no_grad():
        small(images, views, num_keypoints=64)
        with PeakMemory() as memory:
            small(images, views, num_keypoints=64)
        with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiled:
            small(images, views, num_keypoints=64)
    assert profiled.profiler is not None
    assert profiled.profiler.kineto_results is not None
    events = [
        event for event in profiled.profiler.kineto_results.events() if event.name() == "[memory]"
    ]
    held = peak = 0
    for event in sorted(events, key=lambda event: event.start_ns()):
        held += event.nbytes()
        peak = max(peak, held)
    assert memory.peak == pytest.approx(peak, rel=0.02)


# What people and programs read.


def printed(*tables: object) -> str:
    console = Console(width=80, file=io.StringIO(), record=True)
    for table in tables:
        console.print(table)
    return console.export_text()


def test_the_tables_show_every_stage_and_the_papers_figures(cost: Cost) -> None:
    text = printed(cost_table(cost, title="deltas-small"), comparison_table({"deltas-small": cost}))
    for word in (*cost.stages, "total", f"{cost.total.parameters:,}"):
        assert word in text
    for figure in ("16.57", "< 0.002", "67.9", "84.48", "16.9", "134.8", "295.63"):
        assert figure in text
    assert "other stages" not in text


def test_four_networks_fit_a_terminal(cost: Cost) -> None:
    names = ("deltas-small", "deltas-resnet50", "deltas-vgg9", "reference")
    text = printed(comparison_table(dict.fromkeys(names, cost)))
    assert "\u2026" not in text, "cut off"
    for word in ("resnet50", "reference", "triangulation", "67.9"):
        assert word in text


def test_stages_of_no_part_of_the_paper_are_shown_apart(cost: Cost) -> None:
    stages = {("pose" if name == "matcher" else name): it for name, it in cost.stages.items()}
    assert "other stages" in printed(comparison_table({"x": cost._replace(stages=stages)}))


def test_the_papers_parts_sum_to_its_total() -> None:
    assert sum(part.gmacs for part in PAPER_PARTS) == pytest.approx(PAPER_TOTAL.gmacs, abs=0.015)


def test_json_holds_the_same(cost: Cost) -> None:
    found = json.loads(json.dumps(costs_as_json({"deltas-small": cost})))
    network = found["networks"]["deltas-small"]
    assert 2e9 * network["total"]["gmacs_all"] == pytest.approx(cost.total.flops.every)
    assert network["stages"]["encoder"]["parameters"] == cost.stages["encoder"].parameters


def test_the_command_prints_and_writes(
    small: Deltas,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / "cost.json"
    with monkeypatch.context() as patch:

        def printing() -> None:
            """The reader of what is printed has had enough."""
            raise BrokenPipeError

        patch.setattr(command, "table_console", printing)
        with pytest.raises(BrokenPipeError):
            run_cost({"net": small}, image_size=SIZE, num_keypoints=64, repeats=1, json=file)
    assert json.loads(file.read_text())["repeats"] == 1
    run_cost({"net": small}, image_size=SIZE, num_keypoints=64, repeats=1, json=file)
    said = capsys.readouterr()
    assert "net: 2 views, 96 x 128, 64 keypoints" in said.out
    assert "MVDepthNet" not in said.out, "the paper's figures are of another setting"
    assert not said.err
    assert json.loads(file.read_text())["image_size"] == [96, 128]
    run_cost({"net": small}, repeats=1)
    assert "MVDepthNet" in capsys.readouterr().out
    with pytest.raises(UserError, match="2 views"):
        run_cost({"net": small}, num_views=1)
    with pytest.raises(UserError, match="reference takes multiples of 8, not 100 x 128"):
        run_cost({"reference": ReferenceNetwork()}, image_size=(100, 128))
    both = {"reference": ReferenceNetwork(), "net": small}
    run_cost(both, image_size=(100, 128), num_keypoints=64, repeats=1)
    said = capsys.readouterr()
    assert "net: 2 views" in said.out and "reference:" not in said.out
    assert "reference takes multiples of 8" in said.err


def test_the_command_warns_of_what_it_cannot_count(capsys: pytest.CaptureFixture[str]) -> None:
    class Odd(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.encoder = nn.Conv2d(3, 1, 1)

        def forward(self, images: Tensor, views: PosedViews, *, num_keypoints: int) -> Tensor:
            return torch.as_tensor(torch.special.i0(self.encoder(images)))

    run_cost({"odd": Odd()}, image_size=(32, 32), repeats=1)
    assert "aten::i0" in capsys.readouterr().err
