"""``python -m deltas_geom.testing --target kornia``: print a conformance table."""

import argparse
import sys
from collections.abc import Sequence

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
    chosen = parser.parse_args(arguments).target
    names = list(TARGETS) if chosen == "all" else [chosen]
    try:
        targets = [target for name in names for target in TARGETS[name]()]
    except ImportError as error:
        print(f"deltas_geom.testing: {error}", file=sys.stderr)
        return 2
    outcomes = conformance(targets)
    print(table(outcomes))
    failed = any(outcome.target == "deltas" and outcome.result == "FAIL" for outcome in outcomes)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
