"""Few points, as pose estimation has them: one thread, answers first, ratios to torch's SVD.

python benchmarks/small_triangulation.py

Processor time of a call, weighted, float32; goals in brackets are 'at most', of SVD's time.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from triangulation import scene, svd_dlt

from deltas_geom import Status, Triangulator, triangulate, triangulate_points, triangulate_robust

CALLS, REPEATS = 30, 15


class Operations(TorchDispatchMode):
    """Counts torch's operations, views of tensors included; NumPy's are not torch's."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(
        self, operation: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        self.count += 1
        return operation(*args, **(kwargs or {}))


def microseconds(*runs: Callable[[], object]) -> list[float]:
    """Median processor time of a call, the runs taken in turns."""
    times: list[list[float]] = [[] for _ in runs]
    for repeat in range(REPEATS + 1):
        for run, seen in zip(runs, times, strict=True):
            began = time.process_time()
            for _ in range(CALLS):
                run()
            if repeat:  # the first is a warm-up
                seen.append((time.process_time() - began) / CALLS)
    return [1e6 * statistics.median(seen) for seen in times]


def operations(run: Callable[[], object]) -> int:
    with Operations() as counted:
        run()
    return counted.count


def there_and_back(solve: Callable[..., Tensor], inputs: list[Tensor]) -> None:
    solve(*inputs).sum().backward()


def check(points: Tensor, proj: Tensor, pixels: Tensor, weights: Tensor) -> None:
    """Not worth timing unless valid and as accurate."""
    found = triangulate(proj, pixels, weights)
    assert (found.status == Status.OK).all()
    errors = [
        (x - points).norm(dim=-1).median() for x in (found.points, svd_dlt(proj, pixels, weights))
    ]
    assert errors[0] <= 1.02 * errors[1], errors
    assert torch.equal(triangulate_points(proj, pixels, weights), found.points)
    assert torch.equal(Triangulator().prepare(proj).points(pixels, weights), found.points)
    assert (triangulate_robust(proj, pixels, weights).status == Status.OK).all()


def joints() -> None:
    """17 points a call."""
    for num_views in (2, 5, 8):
        proj, pixels, weights, points = scene(num_views)
        seen = [pixels[:, :17].contiguous(), weights[:, :17].contiguous()]
        check(points[:17], proj, *seen)
        rig = Triangulator().prepare(proj)
        runs: dict[str, tuple[Callable[[], object], str]] = {
            "points": (lambda: triangulate_points(proj, *seen), "5"),  # noqa: B023
            "prepared": (lambda: rig.points(*seen), "3.5"),  # noqa: B023
            "triangulate": (lambda: triangulate(proj, *seen), "8"),  # noqa: B023
            "robust": (lambda: triangulate_robust(proj, *seen), "25"),  # noqa: B023
        }
        with torch.no_grad():
            svd, *ours = microseconds(
                lambda: svd_dlt(proj, *seen),  # noqa: B023
                *(run for run, _ in runs.values()),
            )
            counts = [operations(run) for run, _ in runs.values()]
        shown = "  ".join(
            f"{name} {us:.0f} = {us / svd:.1f}x ({goal}), {count} operations"
            for (name, (_, goal)), us, count in zip(runs.items(), ours, counts, strict=True)
        )
        print(f"{num_views} views, 17 points: SVD {svd:.0f} us  {shown}", flush=True)
        inputs = [tensor.clone().requires_grad_() for tensor in (proj, *seen)]
        svd, both = microseconds(
            lambda: there_and_back(svd_dlt, inputs),  # noqa: B023
            lambda: there_and_back(triangulate_points, inputs),  # noqa: B023
        )
        print(
            f"{'':4}forward + backward: SVD {svd:.0f} us, ours {both:.0f} = {both / svd:.1f}x (6)"
        )


@torch.no_grad()
def hundreds() -> None:
    """Where the short way ends and the long one begins."""
    proj, pixels, weights, points = scene(3)
    for count in (100, 300, 1000, 3000):
        seen = [pixels[:, :count].contiguous(), weights[:, :count].contiguous()]
        check(points[:count], proj, *seen)
        svd, ours = microseconds(
            lambda: svd_dlt(proj, *seen),  # noqa: B023
            lambda: triangulate_points(proj, *seen),  # noqa: B023
        )
        goal = " (1)" if count == 1000 else ""
        print(
            f"3 views, {count} points: SVD {svd:.0f} us, ours {ours:.0f} = {ours / svd:.2f}x{goal}"
        )


def main() -> None:
    torch.set_num_threads(1)
    joints()
    hundreds()


if __name__ == "__main__":
    main()
