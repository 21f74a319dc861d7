"""Which interest points are chosen from a detector's logits."""

from typing import NamedTuple

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from deltas_nets.config import DetectorConfig
from deltas_nets.network.lite.detector import (
    CELL,
    Keypoints,
    choose_keypoints,
    detector_heatmap,
    spread_points,
)


class Case(NamedTuple):
    """Logits ``(2, 65, h, w)`` of images whose last cells may reach beyond them."""

    logits: Tensor
    config: DetectorConfig
    size: tuple[int, int]

    def chosen(self) -> Keypoints:
        return choose_keypoints(self.logits, self.config, image_size=self.size)


@st.composite
def cases(draw: st.DrawFn) -> Case:
    size = (draw(st.integers(33, 60)), draw(st.integers(33, 60)))
    config = DetectorConfig(
        num_keypoints=draw(st.integers(8, 80)),
        detected_share=draw(st.floats(0, 1)),
        nms_radius=draw(st.integers(0, 6)),
        border=draw(st.integers(0, 8)),
    )
    generator = torch.Generator().manual_seed(draw(st.integers(0, 1000)))
    cells = tuple(-(-side // CELL) for side in size)
    logits = 4 * torch.randn(2, CELL * CELL + 1, *cells, generator=generator)
    return Case(logits, config, size)


@given(case=cases())
def test_detections_are_the_best_maxima_within_the_border(case: Case) -> None:
    found, (height, width) = case.chosen(), case.size
    heatmap = detector_heatmap(case.logits, image_size=case.size)[:, 0]
    radius, border = case.config.nms_radius, case.config.border
    assert found.pixels.shape == (2, case.config.num_keypoints, 2)
    for image, pixels, scores in zip(heatmap, found.pixels.long(), found.scores, strict=True):
        detected = pixels[scores > 0]
        assert len(detected) <= case.config.num_keypoints * case.config.detected_share
        assert (scores.diff() <= 0).all()  # strongest first, then the spread ones
        column, row = detected.unbind(-1)
        assert torch.equal(image[row, column], scores[scores > 0])
        assert (detected >= border).all()
        assert (column < width - border).all() and (row < height - border).all()
        for x, y in detected.tolist():
            around = image[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1]
            assert image[y, x] == around.max()


@given(case=cases())
def test_the_rest_is_spread_evenly_and_all_are_pixels(case: Case) -> None:
    found = case.chosen()
    spread = spread_points(case.config.num_keypoints, image_size=case.size)
    for pixels, scores in zip(found.pixels, found.scores, strict=True):
        assert torch.equal(pixels[scores == 0], spread[scores == 0])
    assert torch.equal(found.pixels, found.pixels.floor())
    assert (found.pixels >= 0).all()
    assert (found.pixels < torch.tensor(case.size[::-1])).all()


def test_without_a_border_and_a_distance_the_best_pixels_are_taken() -> None:
    config = DetectorConfig(num_keypoints=20, detected_share=1, nms_radius=0, border=0, threshold=0)
    logits = torch.randn(1, 65, 4, 5, generator=torch.Generator().manual_seed(0))
    found = choose_keypoints(logits, config, image_size=(32, 40))
    heatmap = detector_heatmap(logits, image_size=(32, 40)).flatten()
    assert torch.equal(found.scores[0], heatmap.topk(20).values)
