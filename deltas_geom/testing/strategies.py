"""Hypothesis strategies that draw geometry, so that a failure shrinks to a scene.

Everything drawn is well posed by construction: no test needs to filter. Tensors are float64
on the CPU; cast them in the test. An argument for which there is no such scene raises
``ValueError``, as hypothesis does it: when the first one is drawn.
"""

import torch
from torch import Tensor

try:
    from hypothesis import strategies as st
except ImportError as error:  # pragma: no cover
    raise ImportError(
        "deltas_geom.testing.strategies needs hypothesis: pip install 'deltas-depth[test]'"
    ) from error

from deltas_geom.cameras.projection import unproject
from deltas_geom.cameras.views import PosedViews
from deltas_geom.checks import check_counts, check_image_size
from deltas_geom.testing.arguments import check_bounds, check_places
from deltas_geom.testing.planar import DepthScene, MapScene, ScoreScene
from deltas_geom.testing.scenes import IMAGE_SIZE, PosedScene, rigid, scene_from
from deltas_geom.testing.target import DepthRange

_DECADES = 307.0  # beyond, a power of 10 is infinite or loses digits in float64
_MOST_VIEWS = 20


@st.composite
def vectors(draw: st.DrawFn, count: int, *, within: float, size: int = 3) -> Tensor:
    """``(count, size)`` numbers between ``-within`` and ``within``.

    Args:
        draw: given by hypothesis.
        count: how many vectors.
        within: bound of each coordinate, in the caller's unit.
        size: coordinates of a vector.
    """
    check_counts(0, count=count)
    check_counts(1, size=size)
    check_bounds(within=within)
    # Multiples of a 1/1024 of the bound shrink to short numbers and never underflow. Two bytes for
    # each (0, 1, -1, 2, ...) are one draw: as many whole numbers take ten times as long.
    drawn = draw(st.binary(min_size=2 * count * size, max_size=2 * count * size))
    high, low = torch.tensor(list(drawn), dtype=torch.int64).reshape(count, size, 2).unbind(dim=-1)
    place = (256 * high + low) % 2049
    steps = (place + 1) // 2 * (2 * (place % 2) - 1)
    return steps.double() * (within / 1024)


@st.composite
def scales(draw: st.DrawFn, *, decades: float = 3.0) -> float:
    """A positive factor between 10^-decades and 10^decades, evenly over the logarithm."""
    check_bounds(_DECADES, decades=decades)
    return float(10.0 ** draw(st.floats(-decades, decades)))


@st.composite
def intrinsics(draw: st.DrawFn, num_views: int = 1) -> Tensor:
    """``(V, 3, 3)`` cameras of 640 x 480 pixels: focal lengths 400 to 600 px, some skew."""
    check_counts(1, num_views=num_views)
    height, width = IMAGE_SIZE
    change = draw(vectors(num_views, within=1.0, size=5))
    K = torch.zeros(num_views, 3, 3, dtype=torch.float64)
    K[:, 0, 0] = 500 + 100 * change[:, 0]
    K[:, 1, 1] = 500 + 100 * change[:, 1]
    K[:, 0, 2] = width / 2 + 40 * change[:, 2]
    K[:, 1, 2] = height / 2 + 40 * change[:, 3]
    K[:, 0, 1] = 5 * change[:, 4]
    K[:, 2, 2] = 1
    return K


@st.composite
def poses(draw: st.DrawFn, num_views: int = 1, *, turn: float = 0.2, shift: float = 0.04) -> Tensor:
    """``(V, 4, 4)`` rigid transforms near the identity.

    Args:
        draw: given by hypothesis.
        num_views: V.
        turn: bound of each component of axis times angle, rad.
        shift: bound of each coordinate of the translation, metres.
    """
    check_counts(1, num_views=num_views)
    check_bounds(turn=turn, shift=shift)
    return rigid(draw(vectors(num_views, within=turn)), draw(vectors(num_views, within=shift)))


@st.composite
def cameras(draw: st.DrawFn, num_views: int = 2) -> PosedViews:
    """V cameras side by side, looking roughly ahead; neighbours 9 cm or more apart."""
    pose = draw(poses(num_views))
    # The shift is of the centre, along the world's x axis, whatever the camera's turn.
    right = torch.zeros(num_views, 3, 1, dtype=torch.float64)
    right[:, 0, 0] = 0.2 * torch.arange(num_views)
    pose[:, :3, 3:] = -pose[:, :3, :3] @ (right + pose[:, :3, 3:])
    return PosedViews(draw(intrinsics(num_views)), pose)


@st.composite
def posed_scenes(draw: st.DrawFn, num_views: int = 2, num_points: int = 4) -> PosedScene:
    """Views 9 cm or more apart, every point 1.8 m or more ahead of each (of 5 or more: 1 m).

    Args:
        draw: given by hypothesis.
        num_views: V, 2 to 20. Of more, the last in the row would look away from the points.
        num_points: N, 1 or more.
    """
    check_counts(2, num_views=num_views)
    check_counts(1, num_points=num_points)
    if num_views > _MOST_VIEWS:
        raise ValueError(f"num_views must be {_MOST_VIEWS} or less, got {num_views}")
    views = draw(cameras(num_views))
    ahead = torch.tensor([0.0, 0.0, 3.5], dtype=torch.float64)
    return scene_from(views, draw(vectors(num_points, within=1.0)) + ahead)


@st.composite
def rigs(draw: st.DrawFn, num_points: int = 3) -> PosedScene:
    """Two views, turned by up to a radian and moved by up to a metre each against the world.

    Keypoints are anywhere in the first.

    The points are those 4 m ahead of the keypoints; the second view need not see them.
    """
    check_counts(1, num_points=num_points)
    views = PosedViews(draw(intrinsics(2)), draw(poses(2, turn=0.6, shift=0.5)))
    keypoints = draw(image_pixels(num_points))
    depth = torch.full((1, num_points), 4.0, dtype=torch.float64)
    scene = scene_from(views, unproject(views.select([0]), keypoints[None], depth)[0])
    return scene._replace(pixels=torch.stack([keypoints, scene.pixels[1]]))


@st.composite
def epipole_rigs(draw: st.DrawFn, num_points: int = 1, *, within: float = 0.0) -> PosedScene:
    """Two views, the second on the ray of a pixel of the first: keypoints at or near the epipole.

    The second view stands up to 2 m ahead or 1 m behind, 10 cm or more away, turned by up to 0.6
    rad in each axis against the first. The points are 4 m ahead.

    Args:
        draw: given by hypothesis.
        num_points: N.
        within: px, how far each coordinate of the first keypoint may be from the epipole; the
            last of several is up to a million times nearer.
    """
    check_counts(1, num_points=num_points)
    check_bounds(within=within)
    K = draw(intrinsics(2))
    pose = draw(poses(2, turn=0.3, shift=0.5))
    epipole = draw(image_pixels(1))
    distance = draw(st.one_of(st.floats(0.1, 2), st.floats(-1, -0.1)))  # m along z
    center = unproject(
        PosedViews(K[:1], pose[:1]), epipole[None], torch.full((1, 1), distance).double()
    )
    pose[1, :3, 3:] = -pose[1, :3, :3] @ center[0].mT
    views = PosedViews(K, pose)
    share = torch.logspace(0, -6, num_points, dtype=torch.float64)[:, None]
    keypoints = epipole + share * draw(vectors(num_points, within=within, size=2))
    depth = torch.full((1, num_points), 4.0, dtype=torch.float64)
    scene = scene_from(views, unproject(views.select([0]), keypoints[None], depth)[0])
    return scene._replace(pixels=torch.stack([keypoints, scene.pixels[1]]))


@st.composite
def depth_ranges(draw: st.DrawFn) -> DepthRange:
    """(near, far) in metres: near 0.2 to 2, far 1.5 to 20 times that, or infinite."""
    near = draw(st.floats(0.2, 2.0))
    far = draw(st.one_of(st.just(float("inf")), st.floats(1.5, 20).map(lambda share: near * share)))
    return near, far


@st.composite
def image_pixels(
    draw: st.DrawFn, count: int, *, image_size: tuple[int, int] = IMAGE_SIZE
) -> Tensor:
    """``(count, 2)`` pixels anywhere in an image, its edges included."""
    check_counts(0, count=count)
    check_image_size(image_size)
    height, width = image_size
    size = torch.tensor([width, height], dtype=torch.float64)
    return (draw(vectors(count, within=0.5, size=2)) + 0.5) * size - 0.5


@st.composite
def extreme(draw: st.DrawFn, *shape: int, decades: float = 30.0) -> Tensor:
    """Finite numbers of any sign and of magnitude 10^-decades to 10^decades, and zero."""
    check_counts(0, shape=shape)
    check_bounds(_DECADES, decades=decades)
    count = 1
    for size in shape:
        count *= size
    magnitude = st.floats(-decades, decades).map(lambda exponent: 10.0**exponent)
    number = st.one_of(st.just(0.0), magnitude, magnitude.map(lambda value: -value))
    drawn = draw(st.lists(number, min_size=count, max_size=count))
    return torch.tensor(drawn, dtype=torch.float64).reshape(shape)


@st.composite
def map_scenes(
    draw: st.DrawFn, cells: tuple[int, int] = (3, 4), channels: int = 2, num_pixels: int = 5
) -> MapScene:
    """A map of an image in cells of 1 to 8 px on a side, and pixels anywhere in the image.

    Args:
        draw: given by hypothesis.
        cells: (h, w) of the map, each 2 or more: invariants crop a row and a column of it.
        channels: D, 1 or more.
        num_pixels: N, 1 or more.
    """
    check_counts(2, cells=cells)
    check_counts(1, channels=channels, num_pixels=num_pixels)
    height, width = cells
    strides = st.sampled_from([1, 2, 4, 8])
    image_size = (height * draw(strides), width * draw(strides))
    return MapScene(
        draw(vectors(channels, within=1.0, size=height * width)).reshape(channels, *cells),
        draw(image_pixels(num_pixels, image_size=image_size)),
        draw(vectors(num_pixels, within=1.0, size=channels)),
        image_size,
    )


@st.composite
def score_scenes(draw: st.DrawFn, size: tuple[int, int] = (2, 4), dims: int = 2) -> ScoreScene:
    """Logits between -5 and 5 of places within 10, some of them masked, never all.

    Args:
        draw: given by hypothesis.
        size: (h, w) of the logits, 2 places or more.
        dims: D of the positions, 1 or more.
    """
    check_places(size)
    check_counts(1, dims=dims)
    count = size[0] * size[1]
    mask = torch.tensor(draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    mask[draw(st.integers(0, count - 1))] = True
    logits = draw(vectors(1, within=5.0, size=count)).reshape(size)
    return ScoreScene(logits, draw(vectors(count, within=10.0, size=dims)), mask.reshape(size))


@st.composite
def depth_scenes(
    draw: st.DrawFn, num_points: int = 8, image_size: tuple[int, int] = (4, 5)
) -> DepthScene:
    """Pixels in and around a tiny image, so that they collide; depths of 1, 2, ... m; weights."""
    check_counts(1, num_points=num_points)
    check_image_size(image_size)
    order = draw(st.permutations(range(num_points)))
    return DepthScene(
        1.2 * draw(image_pixels(num_points, image_size=image_size)),
        torch.arange(1.0, num_points + 1, dtype=torch.float64)[order],
        0.6 + draw(vectors(1, within=0.4, size=num_points))[0],
        image_size,
    )
