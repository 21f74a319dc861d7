"""Several processes, several passes: the run of one process with the whole batch.

The processes are real ones, started by torchrun and joined by gloo.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from run_fit import (
    CONFIG,
    HELD_OUT,
    KEPT,
    assert_same_state,
    double_precision,
    finish,
    launch,
    logged,
    poison,
    read_checkpoint,
    train,
)
from torch import Tensor, nn

from deltas_nets.config import CONFIGS, MatcherConfig, NetworkConfig, TrainConfig
from deltas_nets.errors import UserError
from deltas_nets.losses.divisors import (
    Divisors,
    DivisorsOverProcesses,
    DivisorsToCome,
    KnownDivisors,
)
from deltas_nets.losses.seen import masked_mean
from deltas_nets.network.deltas import Deltas
from deltas_nets.train import fit as fit_module
from deltas_nets.train.batch_norm import Statistics, prepare_batch_norm
from deltas_nets.train.batches import BatchMaker
from deltas_nets.train.fit import Start, fit
from deltas_nets.train.loader import room_loader
from deltas_nets.train.processes import check_batch_size
from deltas_nets.train.step import Objective, unreached

# Rooms that are drawn in double precision are for no others.
OWN = replace(CONFIG.data, cache=str(Path(KEPT.name) / "double"))
FROZEN = replace(CONFIG, steps=3, freeze_batch_norm=True, data=OWN)


def assert_close(one: Path, other: Path, tolerance: float) -> None:
    """Weights and average of two runs agree within an absolute tolerance, losses as closely.

    A loss may be large: then it is the share of it.
    """
    first, second = read_checkpoint(one), read_checkpoint(other)
    assert first["step"] == second["step"]
    for part in ("model", "average"):
        torch.testing.assert_close(second[part], first[part], rtol=0, atol=tolerance)
    for entry, expected in zip(logged(other), logged(one), strict=True):
        if expected["total"] != "nan":  # parts of a loss that is none are of one process
            assert entry == pytest.approx(expected, rel=tolerance, abs=tolerance)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one process, which sees NaN in the second of three steps."""
    folder = tmp_path_factory.mktemp("runs") / "alone"
    with double_precision():
        poison()
        train(folder, FROZEN, Start())
    content = read_checkpoint(folder)
    assert content["model"]["encoder._bn0.weight"].dtype == torch.float64
    return folder


def test_two_processes_train_to_the_weights_of_one_and_both_skip_what_one_sees_as_nan(
    tmp_path: Path, alone: Path
) -> None:
    # Here Fabric starts the second process itself.
    finish(launch(tmp_path / "two", replace(FROZEN, devices=2), "double", "poison=1"))
    assert_close(alone, tmp_path / "two", 1e-9)
    assert [e["total"] == "nan" for e in logged(tmp_path / "two")] == [False, True, False]


@pytest.mark.slow
def test_two_processes_of_two_passes_train_to_the_weights_of_one(
    tmp_path: Path, alone: Path
) -> None:
    config = replace(FROZEN, accumulate=2)
    finish(launch(tmp_path / "two", config, "double", "poison=1", processes=2))
    assert_close(alone, tmp_path / "two", 1e-9)


@pytest.mark.slow
def test_nan_in_one_process_ends_both(tmp_path: Path) -> None:
    said = finish(launch(tmp_path / "run", CONFIG, "poison=1", processes=2), code=1)
    assert (
        said.count("UserError: training diverged: no usable gradient in the 2 steps up to 5") == 2
    )
    content = read_checkpoint(tmp_path / "run")
    assert content["step"] == 3
    assert all(tensor.isfinite().all() for tensor in content["model"].values())


@pytest.mark.slow
def test_sigterm_to_one_process_stops_both_after_a_step_and_they_go_on(tmp_path: Path) -> None:
    config = replace(CONFIG, steps=4)
    whole = launch(tmp_path / "whole", config, processes=2)
    said = finish(launch(tmp_path / "broken", config, "stop=1", processes=2), code=1)
    assert "KeyboardInterrupt" in said
    assert read_checkpoint(tmp_path / "broken")["step"] == 2
    finish(whole)
    finish(launch(tmp_path / "broken", config, "resume", processes=2))
    assert_same_state(tmp_path / "broken", tmp_path / "whole")


def test_passes_add_up_to_the_gradient_of_the_whole_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_module, "validation_rooms", lambda: HELD_OUT)
    # A step of plain gradient descent shows the gradient; AdamW would blow rounding up.
    monkeypatch.setattr(torch.optim, "AdamW", _descent)
    for name, passes in (("one", 1), ("four", 4)):
        config = replace(FROZEN, accumulate=passes, data=CONFIG.data)
        fit(config, tmp_path / name, Start(), stop=1, log_every=1)
    assert_close(tmp_path / "one", tmp_path / "four", 1e-6)


def _descent(groups: list[dict[str, object]], lr: float, weight_decay: float) -> torch.optim.SGD:
    return torch.optim.SGD(groups, lr=lr)


@given(
    st.lists(st.tuples(st.integers(0, 5), st.floats(-3, 3)), min_size=2, max_size=4),
    st.sampled_from(["processes", "passes"]),
)
def test_means_of_parts_average_to_the_mean_of_the_whole(
    parts: list[tuple[int, float]], kind: str
) -> None:
    values = [torch.arange(5.0) + value for _, value in parts]
    masks = [torch.arange(5) < count for count, _ in parts]
    total = torch.stack([mask.sum() for mask in masks]).sum()
    make: dict[str, Callable[[], Divisors]] = {
        "processes": lambda: DivisorsOverProcesses(lambda count: total, len(parts)),
        "passes": lambda: KnownDivisors(total[None], len(parts)),
    }
    means = [masked_mean(*pair, make[kind]()) for pair in zip(values, masks, strict=True)]
    whole = masked_mean(torch.cat(values), torch.cat(masks))
    torch.testing.assert_close(torch.stack(means).mean(), whole)


def test_a_first_pass_counts_what_the_second_asks_for() -> None:
    model = Deltas(CONFIG.network)
    objective = Objective(model, CONFIG)
    batch = BatchMaker(CONFIG)(next(iter(room_loader(CONFIG, start=0, stop=1))), 0)
    whole, halves = DivisorsToCome(), [DivisorsToCome(), DivisorsToCome()]
    frozen = replace(CONFIG, freeze_batch_norm=True)
    prepare_batch_norm(model, frozen, processes=1)
    with torch.no_grad():
        losses = objective(batch, whole)
        for half, divisors in zip(batch.split(2), halves, strict=True):
            objective(half, divisors)
        total = halves[0].all() + halves[1].all()
        assert torch.equal(total, whole.all())
        assert (total > 0).sum() > 10
        parts = [objective(half, KnownDivisors(total, 2)) for half in batch.split(2)]
    means = {name: (one + parts[1].terms[name]) / 2 for name, one in parts[0].terms.items()}
    torch.testing.assert_close(means, losses.terms, rtol=1e-4, atol=1e-6)


ALONE = NetworkConfig(matcher=MatcherConfig(num_samples=16, context_rounds=0))
NETWORKS = {
    "deltas-small": CONFIG.network,
    "per view": NetworkConfig(matcher=MatcherConfig(kind="per_view", num_samples=16)),
    "deltas-vgg9": CONFIGS["deltas-vgg9"],
    "points alone": ALONE,
}


@pytest.mark.parametrize("name", NETWORKS)
def test_parameters_that_no_loss_reaches_are_found(name: str) -> None:
    config = replace(CONFIG, network=NETWORKS[name], batch_size=1)
    model = Deltas(config.network)
    model.idle = nn.Linear(2, 2)
    found = unreached(model, config)
    assert found == ["idle.weight", "idle.bias"]
    assert all(parameter.grad is None for parameter in model.parameters())
    # Whatever the number of views, the others get a gradient.
    for views in (2, 3):
        here = replace(config, min_views=views, max_views=views)
        batch = BatchMaker(here)(next(iter(room_loader(here, start=0, stop=1))), 0)
        model.zero_grad()
        Objective(model, here)(batch).total.backward()
        without = [name for name, p in model.named_parameters() if p.grad is None]
        assert without == found


@pytest.mark.slow
def test_parameters_that_no_loss_reaches_do_not_hold_two_processes_up(tmp_path: Path) -> None:
    finish(launch(tmp_path / "run", replace(CONFIG, steps=3), "idle", processes=2))
    assert read_checkpoint(tmp_path / "run")["step"] == 3


def test_batches_that_do_not_divide_are_refused() -> None:
    with pytest.raises(UserError, match=r"4 rooms do not divide into 3 processes times 2.*of 6"):
        check_batch_size(replace(CONFIG, accumulate=2), 3)
    check_batch_size(replace(CONFIG, accumulate=2), 2)
    with pytest.raises(ValueError, match="multiple of accumulate"):
        replace(CONFIG, accumulate=3)


def test_batch_norm_is_frozen_or_left_as_the_config_says() -> None:
    def norms(config: TrainConfig) -> list[nn.Module]:
        model = Deltas(config.network)
        prepare_batch_norm(model, config, processes=2)
        return [module for module in model.modules() if isinstance(module, nn.BatchNorm2d)]

    assert all(norm.training for norm in norms(CONFIG))
    assert not any(norm.training for norm in norms(replace(CONFIG, freeze_batch_norm=True)))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch shares statistics on GPUs only")
def test_batch_norm_is_shared_between_gpus_and_keeps_its_parameters() -> None:
    model = Deltas(CONFIG.network).cuda()
    before = dict(model.named_parameters())
    prepare_batch_norm(model, CONFIG, processes=2)
    assert any(isinstance(module, nn.SyncBatchNorm) for module in model.modules())
    after = dict(model.named_parameters())
    assert before.keys() == after.keys()
    assert all(after[name] is parameter for name, parameter in before.items())


def test_statistics_are_put_back() -> None:
    norm = nn.BatchNorm2d(3)
    before: dict[str, Tensor] = {name: t.clone() for name, t in norm.state_dict().items()}
    statistics = Statistics(norm)
    norm(torch.full((2, 3, 4, 4), torch.nan))
    assert norm.running_mean is not None and norm.running_mean.isnan().all()
    statistics.restore()
    for name, tensor in norm.state_dict().items():
        assert torch.equal(tensor, before[name])
