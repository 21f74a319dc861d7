"""The modules are the functions with fixed settings."""

import torch
from torch import nn
from torch.testing import assert_close

from deltas_geom import (
    DepthRasterizer,
    EpipolarSampler,
    Triangulator,
    epipolar_segments,
    rasterize_depth,
    sample_segments,
    triangulate,
)
from deltas_geom.testing import forward_motion
from deltas_geom.testing.scenes import IMAGE_SIZE


def test_the_sampler_is_segments_and_samples() -> None:
    scene = forward_motion()
    sampler = EpipolarSampler(6, depth_range=(0.7, 9), spacing="pixels", offsets=[-1, 1])
    samples = sampler(scene.views, scene.pixels[0], IMAGE_SIZE)
    segments = epipolar_segments(
        scene.views, scene.pixels[0], depth_range=(0.7, 9), image_size=IMAGE_SIZE
    )
    wanted = sample_segments(segments, 6, spacing="pixels", offsets=(-1, 1), image_size=IMAGE_SIZE)
    for ours, theirs in zip(samples, wanted, strict=True):
        assert_close(ours, theirs, rtol=0, atol=0)


def test_the_triangulator_is_triangulate() -> None:
    scene = forward_motion()
    weights = torch.tensor([[1.0], [0.5]]).double().expand(2, 3)
    mask = torch.tensor([[True, True, False], [True, True, True]])
    result = Triangulator(frame="world", covariance=True)(
        scene.views.proj, scene.pixels, weights, mask
    )
    wanted = triangulate(
        scene.views.proj, scene.pixels, weights, mask, frame="world", covariance=True
    )
    for ours, theirs in zip(result, wanted, strict=True):
        assert_close(ours, theirs, rtol=0, atol=0)


def test_the_rasterizer_is_rasterize_depth() -> None:
    pixels, depth = torch.rand(9, 2) * 5, torch.rand(9)
    sparse = DepthRasterizer(reduce="mean", splat="bilinear")(pixels, depth, (4, 5))
    wanted = rasterize_depth(pixels, depth, image_size=(4, 5), reduce="mean", splat="bilinear")
    assert_close(sparse.depth, wanted.depth, rtol=0, atol=0)


def test_modules_have_nothing_to_learn_or_to_save() -> None:
    modules = nn.ModuleList(
        [EpipolarSampler(4, depth_range=(1, 2)), Triangulator(), DepthRasterizer()]
    )
    assert not list(modules.parameters()) and not modules.state_dict()


def test_modules_and_prepared_cameras_print_their_settings() -> None:
    net = nn.Sequential(
        Triangulator(max_residual=4.0),
        EpipolarSampler(6, depth_range=(0.5, 9.0)),
        DepthRasterizer(splat="bilinear"),
    )
    for said in (
        "frame='rig', covariance=False, max_residual=4.0",
        "num_samples=6, depth_range=(0.5",
    ):
        assert said in repr(net)
    assert "reduce='front', splat='bilinear'" in repr(net)
    rig = Triangulator(max_residual=4.0).prepare(torch.zeros(2, 4, 3, 4))
    assert repr(rig).startswith("PreparedTriangulator(proj (2, 4, 3, 4), frame='rig', ")
    assert repr(rig).endswith("max_residual=4.0) float32 cpu")
