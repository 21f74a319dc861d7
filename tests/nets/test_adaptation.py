"""A teacher's score maps from many sides, brought together."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.geometry.transform import warp_perspective
from torch import Tensor

from deltas_geom.cameras.homogeneous import from_homogeneous, to_homogeneous
from deltas_nets.distill.adaptation import adapted_scores, random_homography

SIZE = (60, 80)
seeds = st.integers(0, 10_000)


def spots(places: Tensor, width: float = 2.0) -> Tensor:
    """A picture ``(1, 3, H, W)`` with a bright spot at each of ``(N, 2)`` pixels."""
    rows, columns = torch.meshgrid(*(torch.arange(float(side)) for side in SIZE), indexing="ij")
    pixels = torch.stack([columns, rows], dim=-1)
    distance = (pixels[None] - places[:, None, None]).square().sum(dim=-1)
    return torch.exp(-distance / (2 * width**2)).amax(dim=0).expand(1, 3, *SIZE)


def brightness(images: Tensor) -> Tensor:
    """A teacher that moves with the picture: bright places are its points."""
    return images.mean(dim=1, keepdim=True)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@settings(max_examples=25)
@given(seed=seeds, x=st.floats(20, 59), y=st.floats(15, 44))
def test_a_warped_picture_has_its_spots_where_the_homography_sends_them(
    seed: int, x: float, y: float
) -> None:
    """Pins kornia's conventions: pixel centres at whole numbers, from old to new places."""
    place = torch.tensor([[x, y]])
    homography = random_homography(SIZE, generator(seed))
    expected = from_homogeneous(to_homogeneous(place) @ homography[0].mT)[0]
    if not (8 < expected[0] < SIZE[1] - 9 and 8 < expected[1] < SIZE[0] - 9):
        return
    warped = warp_perspective(spots(place), homography, SIZE)[0, 0]
    rows, columns = torch.meshgrid(*(torch.arange(float(side)) for side in SIZE), indexing="ij")
    weight = warped.square() / warped.square().sum()
    found = torch.stack([(weight * columns).sum(), (weight * rows).sum()])
    assert (found - expected).norm() < 0.2


@settings(max_examples=15)
@given(seed=seeds)
def test_points_that_move_with_the_picture_stay_where_they_are(seed: int) -> None:
    places = torch.tensor([[25.0, 20], [55, 40], [40, 30]])
    scores = adapted_scores(brightness, spots(places), looks=8, random=generator(seed))[0, 0]
    for x, y in places.int().tolist():
        around = scores[y - 3 : y + 4, x - 3 : x + 4]
        assert divmod(int(around.argmax()), 7) == (3, 3)
        assert scores[y, x] > 0.85  # what bilinear reading leaves of a peak


@settings(max_examples=15)
@given(seed=seeds)
def test_what_is_found_from_one_side_only_fades(seed: int) -> None:
    """A teacher that sees a point where the picture's own frame has its centre."""
    own = spots(torch.tensor([[40.0, 30]]), width=1.0)[:, :1]
    scores = adapted_scores(
        lambda _: own, own.expand(1, 3, *SIZE), looks=16, random=generator(seed)
    )
    once = adapted_scores(lambda _: own, own.expand(1, 3, *SIZE), looks=1, random=generator(seed))
    assert torch.equal(once, own)
    assert scores[0, 0, 30, 40] < 0.6


@settings(max_examples=15)
@given(seed=seeds, looks=st.integers(1, 6))
def test_a_mean_of_scores_is_a_score_and_repeats_itself(seed: int, looks: int) -> None:
    image = torch.rand(1, 3, *SIZE, generator=generator(seed))
    scores = adapted_scores(brightness, image, looks=looks, random=generator(seed))
    again = adapted_scores(brightness, image, looks=looks, random=generator(seed))
    assert torch.equal(scores, again)
    assert scores.shape == (1, 1, *SIZE)
    assert float(scores.min()) >= 0 and float(scores.max()) <= 1 + 1e-5
    # The same everywhere: no place is counted by looks that did not see it.
    constant = adapted_scores(
        lambda i: torch.ones_like(i[:, :1]), image, looks=looks, random=generator(seed)
    )
    assert torch.allclose(constant, torch.ones(1, 1, *SIZE), atol=1e-4)


@settings(max_examples=30)
@given(seed=seeds)
def test_homographies_keep_the_middle_in_the_picture(seed: int) -> None:
    homography = random_homography(SIZE, generator(seed))
    middle = torch.tensor([[(SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2]])
    moved = from_homogeneous(to_homogeneous(middle) @ homography[0].mT)[0]
    assert 0 < moved[0] < SIZE[1] - 1 and 0 < moved[1] < SIZE[0] - 1
    assert float(torch.linalg.det(homography)) > 0
