"""Costs as tables for people and as JSON for programs."""

from collections.abc import Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from deltas_nets.cost.literature import OTHER_TOTALS, PAPER_PARTS, PAPER_TOTAL
from deltas_nets.cost.measure import Cost, StageCost
from deltas_nets.cost.stages import GEOMETRY

PARTS = {
    "detector and descriptor": (
        "encoder",
        "detector",
        "descriptor",
        "detector_head",
        "descriptor_head",
    ),
    "matching and triangulation": ("matcher", "match_norm", "judge", GEOMETRY),
    "sparse to dense": ("densifier",),
}
"""The paper's parts of a network, and the stages that are in each, in any of our networks."""


def cost_table(cost: Cost, *, title: str) -> Table:
    """One network's cost: a row for each stage."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("")
    for name in ("parameters", "GMACs, products", "GMACs, all", "ms"):
        table.add_column(name, justify="right")
    for name, stage in cost.stages.items():
        table.add_row(name, *_cells(stage))
    table.add_section()
    table.add_row("total", *_cells(cost.total))
    return table


def comparison_table(costs: Mapping[str, Cost]) -> Table:
    """Multiply-accumulates of convolutions and matrix products beside the paper's figures.

    Args:
        costs: by network, of two views at 240 x 320 with 512 keypoints: the paper's setting.
    """
    table = Table(
        title="GMACs of 2 views beside those that the paper reports",
        title_justify="left",
        box=SIMPLE_HEAD,
    )
    table.add_column("")
    # Four networks fit a terminal's 80 columns if only the names of the parts wrap.
    for name in costs:
        heading = name.replace("-", "-\n") + "\n(counted)"
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("ResNet-50\n(paper)", justify="right", no_wrap=True)
    for published in PAPER_PARTS:
        counted = (f"{_part_gmacs(cost, published.name):.3f}" for cost in costs.values())
        table.add_row(published.name, *counted, str(published))
    if any(_other_stages(cost) for cost in costs.values()):
        counted = (f"{_products(cost, _other_stages(cost)):.3f}" for cost in costs.values())
        table.add_row("other stages", *counted, "")
    table.add_section()
    totals = (f"{gmacs(cost.total.flops.products):.3f}" for cost in costs.values())
    table.add_row("total", *totals, str(PAPER_TOTAL))
    table.add_section()
    for published in OTHER_TOTALS:
        table.add_row(f"total, {published.name}", *("" for _ in costs), str(published))
    return table


def costs_as_json(costs: Mapping[str, Cost]) -> dict[str, Any]:
    """Everything in the costs and the paper's figures, JSON-ready.

    Args:
        costs: by network.
    """
    published = (*PAPER_PARTS, PAPER_TOTAL, *OTHER_TOTALS)
    return {
        "networks": {name: _cost_as_json(cost) for name, cost in costs.items()},
        "reported by the paper": [figure._asdict() for figure in published],
    }


def gmacs(flops: int) -> float:
    """1e9 multiply-accumulates, of two operations each."""
    return flops / 2e9


def _cells(stage: StageCost) -> tuple[str, str, str, str]:
    return (
        f"{stage.parameters:,}",
        f"{gmacs(stage.flops.products):.4f}",
        f"{gmacs(stage.flops.every):.4f}",
        f"{1e3 * stage.seconds:.1f}",
    )


def _part_gmacs(cost: Cost, part: str) -> float:
    return _products(cost, PARTS[part])


def _other_stages(cost: Cost) -> tuple[str, ...]:
    known = {stage for stages in PARTS.values() for stage in stages}
    return tuple(name for name in cost.stages if name not in known)


def _products(cost: Cost, names: tuple[str, ...]) -> float:
    found = (cost.stages[name].flops.products for name in names if name in cost.stages)
    return gmacs(sum(found))


def _cost_as_json(cost: Cost) -> dict[str, Any]:
    return {
        "stages": {name: _stage_as_json(stage) for name, stage in cost.stages.items()},
        "total": _stage_as_json(cost.total),
        "peak_bytes": cost.peak_bytes,
        "operators without a formula": cost.unknown,
    }


def _stage_as_json(stage: StageCost) -> dict[str, float]:
    return {
        "parameters": stage.parameters,
        "gmacs_products": gmacs(stage.flops.products),
        "gmacs_all": gmacs(stage.flops.every),
        "seconds": stage.seconds,
    }
