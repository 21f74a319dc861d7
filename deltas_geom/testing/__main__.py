"""``python -m deltas_geom.testing --target kornia``: print a conformance table."""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace

from deltas_geom.testing.conformance import conformance, table
from deltas_geom.testing.targets import TARGETS


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; the exit code is 0 if deltas passes all that it was asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m deltas_geom.testing",
        description="Ask implementations of multi-view geometry for the invariants of every right "
        "one. '-' = not offered. Exit code 1 if deltas fails one; others' failures are findings.",
    )
    parser.add_argument(
        "--target", choices=[*TARGETS, "all"], default="all", help="whom to ask (default: all)"
    )
    parser.add_argument(
        "--tolerance",
        type=_tolerance,
        metavar="T",
        help="of pixels (px) and points (m), all else in proportion; default 1e-6. For targets "
        "that compute in float32: 3e-3",
    )
    options = parser.parse_args(arguments)
    chosen = options.target
    names = list(TARGETS) if chosen == "all" else [chosen]
    try:
        targets = [target for name in names for target in TARGETS[name]()]
    except ImportError as error:
        print(f"deltas_geom.testing: {error}", file=sys.stderr)
        return 2
    if options.tolerance is not None:
        targets = [replace(target, tolerance=options.tolerance) for target in targets]
    outcomes = conformance(targets)
    print(table(outcomes))
    failed = any(outcome.target == "deltas" and outcome.result == "FAIL" for outcome in outcomes)
    return int(failed)


def _tolerance(text: str) -> float:
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be positive and finite, got {text}")
    return value


if __name__ == "__main__":
    sys.exit(main())
