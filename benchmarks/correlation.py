"""Correlation read at samples, beside reading D channels and multiplying, one thread.

Goals, against the dot product of sampled descriptors, 512 keypoints, 300 samples, float32:
30 x 40 map, 128 channels: forward 40x, with backward 30x, kept for backward 1/30;
120 x 160 map, 64 channels: forward 2x, with backward 1.3x, kept for backward 1/7;
lengths brought to one after sampling, 30 x 40: forward 10x, with backward 14x.

Peers: "product, sum" is the plain form, "einsum" becomes a matrix product, the fastest known.
Kept: distinct storages that autograd saves, inputs included on both sides. Processor time.

python benchmarks/correlation.py
"""

import statistics
import time
from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom import Samples, correlate, correlate_normalized, normalize_pixels

SIZE = (240, 320)  # of the image, px
NUM_KEYPOINTS, NUM_SAMPLES, REPEATS = 512, 300, 9
SHORTEST = 0.1  # s, of a measurement
Score = Callable[[Tensor, Tensor, Samples], Tensor]


def read_channels(feature_map: Tensor, samples: Samples) -> Tensor:  # (V, D, N, S)
    grid = normalize_pixels(samples.pixels, image_size=SIZE).squeeze(-3)
    return F.grid_sample(feature_map, grid, padding_mode="border", align_corners=False)


def product_sum(descriptors: Tensor, feature_map: Tensor, samples: Samples) -> Tensor:
    read = read_channels(feature_map, samples)
    return torch.where(samples.mask, (descriptors.mT[..., None] * read).sum(1)[..., None, :], 0.0)


def einsum(
    descriptors: Tensor, feature_map: Tensor, samples: Samples, unit: bool = False
) -> Tensor:
    read = read_channels(feature_map, samples)
    read = F.normalize(read, dim=1) if unit else read
    dots = torch.einsum("nd,vdns->vns", descriptors, read)
    return torch.where(samples.mask, dots[..., None, :], 0.0)


def scene(size: tuple[int, int], channels: int) -> tuple[Tensor, Tensor, Samples]:
    """Unit descriptors and features, samples evenly along segments between random ends."""
    random = torch.Generator().manual_seed(0)
    descriptors = F.normalize(torch.randn(NUM_KEYPOINTS, channels, generator=random), dim=-1)
    features = F.normalize(torch.randn(1, channels, *size, generator=random), dim=1)
    ends = torch.rand(2, 1, NUM_KEYPOINTS, 1, 1, 2, generator=random) * torch.tensor(SIZE[::-1])
    pixels = torch.lerp(ends[0], ends[1], torch.linspace(0, 1, NUM_SAMPLES)[:, None]) - 0.5
    mask = torch.rand(pixels.shape[:-1], generator=random) < 0.9
    samples = Samples(pixels, torch.ones(1, NUM_KEYPOINTS, NUM_SAMPLES), mask)
    return descriptors.requires_grad_(), features.requires_grad_(), samples


def kept(score: Score, inputs: tuple[Tensor, Tensor, Samples]) -> float:
    """Megabytes that autograd keeps between forward and backward."""
    sizes: dict[int, int] = {}

    def count(tensor: Tensor) -> Tensor:
        sizes[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
        graph = score(*inputs)  # held, or its storages would be used again
    assert graph.requires_grad
    return sum(sizes.values()) / 1e6


def seconds(call: Callable[[], object]) -> float:
    """Processor time of a call, the mean of as many as take a while.

    One call of a few milliseconds would pay for the memory that the one before gave back.
    """
    call()
    count, began = 0, time.process_time()
    while (spent := time.process_time() - began) < SHORTEST:
        call()
        count += 1
    return spent / count


def compare(case: str, size: tuple[int, int], channels: int, scores: dict[str, Score]) -> None:
    """A table; the first function is ours."""
    inputs = scene(size, channels)
    upstream = torch.randn(inputs[2].mask.shape, generator=torch.Generator().manual_seed(1))
    times: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in scores}
    wanted: list[Tensor] = []

    def forward(score: Score) -> Tensor:
        with torch.no_grad():
            return score(*inputs)

    def both(score: Score) -> tuple[Tensor, ...]:
        return torch.autograd.grad((score(*inputs) * upstream).sum(), inputs[:2])

    for repeat in range(REPEATS + 1):  # the first checks, and warms up
        for name, score in scores.items():
            if repeat == 0:
                found = [forward(score), *both(score)]
                wanted = wanted or found
                for answer, other in zip(found, wanted, strict=True):
                    torch.testing.assert_close(answer, other, rtol=1e-4, atol=1e-4)
                continue
            times[name][0].append(seconds(partial(forward, score)))
            times[name][1].append(seconds(partial(both, score)))
    rows = [[*map(statistics.median, times[name]), kept(scores[name], inputs)] for name in scores]
    for name, row in zip(scores, rows, strict=True):
        ratios = " ".join(f"{value / best:7.1f}x" for value, best in zip(row, rows[0], strict=True))
        print(
            f"{case:>22} {name:>12} {1e3 * row[0]:8.1f} {1e3 * row[1]:8.1f} {row[2]:7.1f} {ratios}"
        )


def main() -> None:
    torch.set_num_threads(1)
    print(f"{'':>35} {'forward':>8} {'+ back':>8} {'kept MB':>7}  times ours")
    ours, unit = partial(correlate, image_size=SIZE), partial(correlate_normalized, image_size=SIZE)
    plain: dict[str, Score] = {"ours": ours, "product, sum": product_sum, "einsum": einsum}
    normalized: dict[str, Score] = {"ours": unit, "einsum": partial(einsum, unit=True)}
    for size, channels in (((30, 40), 128), ((120, 160), 64)):
        shape = f"{size[0]}x{size[1]}, {channels}"
        compare(shape, size, channels, plain)
        compare(f"{shape}, unit", size, channels, normalized)


if __name__ == "__main__":
    main()
