"""Every step of a series for every network, each measured once."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from torch import nn

from deltas_nets import __version__
from deltas_nets.ablations.journal import Journal, key_of
from deltas_nets.ablations.steps import Series, Step
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.cost.literature import PAPER_SETTING
from deltas_nets.cost.measure import cost_of
from deltas_nets.cost.report import gmacs
from deltas_nets.errors import UserError
from deltas_nets.evaluate.capture import Scoring, evaluate_network
from deltas_nets.evaluate.record import finite
from deltas_nets.evaluate.results import METRICS_VERSION
from deltas_nets.evaluate.scores import CaptureScores
from deltas_nets.predict.dense import DensePredictor
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.ours import DeltasPredictor
from deltas_nets.predict.predictor import Predictor, load_predictor
from deltas_nets.predict.reference import ReferencePredictor

__all__ = ["Measured", "Measurement", "measure"]

METRICS = ("abs_rel", "abs_diff", "sq_rel", "delta1", "delta2", "delta3")
"""The supplement's."""
NO_DEPTH = "no map has depth where the true depth is"


@dataclass(frozen=True)
class Measurement:
    """What decides rows besides the network and the step."""

    capture: Capture
    view_sets: tuple[ViewSet, ...]
    predict: PredictConfig
    seed: int = 0

    def key(self, series: Series, step: Step, network: Mapping[str, Any]) -> str:
        """Of a row: the same only if the figures must be."""
        return key_of(
            {
                "series": series.name,
                "step": step.name,
                "network": network,
                "capture": [self.capture.path.name, self.capture.fingerprint()],
                "view_sets": [[views.anchor, *views.sources] for views in self.view_sets],
                "predict": vars(self.predict),
                "search": step.search,
                "seed": self.seed,
                "metrics": METRICS_VERSION,
                "deltas": __version__,
            }
        )


class Measured(NamedTuple):
    """A table.

    Attributes:
        rows: a network and a step each.
        weights: what identifies each network.
    """

    rows: list[dict[str, Any]]
    weights: dict[str, dict[str, str]]


def measure(
    series: Series,
    networks: Sequence[str],
    measurement: Measurement,
    journal: Journal,
    *,
    device: str = "cpu",
    report: Callable[[str], None] = lambda _: None,
) -> Measured:
    """Measure what the journal lacks.

    A network that lacks a setting has a row that says so, without figures.

    Args:
        series: what is changed.
        networks: weights, by name or file.
        measurement: data and protocol.
        journal: of rows that are done.
        device: where to compute.
        report: called with the name of every finished step.

    Raises:
        UserError: no such weights, a method of the series is not installed, or no step could be
            measured.
    """
    loaded = {name: load_predictor(name, device) for name in networks}
    for step in series.steps:
        if step.weights is not None:
            load_predictor(step.weights, device)  # what is not installed is told before all work
    shown = _shown(loaded)
    records = {
        name: found.weights_record(name) | {"name": shown[name]} for name, found in loaded.items()
    }
    rows: list[dict[str, Any]] = []
    for name, predictor in loaded.items():
        for step in series.steps:
            if step.once and name != networks[0]:
                continue
            identity = {"name": "any"} if step.once else _identity(records[name])
            key = measurement.key(series, step, identity)
            if key in journal:
                row = journal[key]
            else:
                row = finite(_row(series, step, predictor, measurement, device))
                if "note" not in row:  # what is lacking may be there next time
                    journal.add(key, row)
            rows.append({"weights": "" if step.once else shown[name], **row})
            report(f"{name} {step.name}")
    if all(row.get("abs_rel") is None for row in rows):
        notes = "; ".join(sorted({str(row.get("note", NO_DEPTH)) for row in rows}))
        raise UserError(
            f"nothing was measured ({notes})", series.name, "mend that, or use other weights"
        )
    return Measured(rows, {shown[name]: record for name, record in records.items()})


def _row(
    series: Series, step: Step, predictor: Predictor, measurement: Measurement, device: str
) -> dict[str, Any]:
    head: dict[str, Any] = {"step": step.name, "value": step.value}
    view_sets = [step.views(views) for views in measurement.view_sets]
    wanted = int(step.value or 0) if series.name == "views" else 0
    if wanted > 1 + max(len(views.sources) for views in view_sets):
        return head | {"note": f"no view set has {wanted} views"}
    config = measurement.predict
    scoring = Scoring(config.depth_range)
    if step.search is not None:
        config = replace(config, depth_range=step.search)
    try:
        other = None if step.weights is None else load_predictor(step.weights, device)
        network = step.change(other or predictor)
        network.check_asked(config, measurement.capture, view_sets)
        scores = evaluate_network(network, measurement.capture, view_sets, config, scoring)
    except UserError as error:
        return head | {"note": str(error)}
    return head | _figures(scores) | (_cost(predictor) if series.name == "architecture" else {})


def _figures(scores: CaptureScores) -> dict[str, Any]:
    found: dict[str, Any] = {name: getattr(scores.dense, name) for name in METRICS}
    found["median_abs_rel"] = scores.median_scaled.abs_rel
    if scores.sparse is not None:
        found |= {f"sparse_{name}": getattr(scores.sparse, name) for name in METRICS}
        found["sparse_coverage"] = scores.sparse.coverage
    return found | {"frames": len(scores.maps), "failed": len(scores.failed)}


def _cost(predictor: Predictor) -> dict[str, Any]:
    """Of a network at the paper's setting; nothing of a method that is none, or a part of one."""
    network = _network_of(predictor)
    if network is None:
        return {}
    cost = cost_of(network, *PAPER_SETTING, repeats=1).total
    return {"gmacs": gmacs(cost.flops.products), "parameters": cost.parameters}


def _network_of(predictor: Predictor) -> nn.Module | None:
    if isinstance(predictor, DeltasPredictor):
        return None if predictor.without_points else predictor.encode.model
    if isinstance(predictor, ReferencePredictor):
        return predictor.network
    return predictor.model if isinstance(predictor, DensePredictor) else None


def _shown(names: Iterable[str]) -> dict[str, str]:
    """Weights as a table has them: of files so many folders and the name that no two are alike."""
    paths = {name: Path(name).parts for name in names}
    for length in range(2, 1 + max([2, *map(len, paths.values())])):
        shown = {name: "/".join(parts[-length:]) for name, parts in paths.items()}
        if len(set(shown.values())) == len(shown):
            return shown
    return {name: name for name in paths}  # one path, written in two ways


def _identity(record: Mapping[str, str]) -> dict[str, str]:
    """What a network is, wherever its file lies."""
    return {k: v for k, v in record.items() if k == "sha256"} or dict(record)
