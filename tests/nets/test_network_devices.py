"""Training on a device that is not the host's: what it makes, and what it would wait for."""

import dataclasses
from collections import Counter
from functools import cache
from typing import Any

import pytest
import torch
from stand_in_device import DEVICE, on_device, one_device, to_device
from torch import Tensor, nn

from deltas_geom import PosedViews
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import TRAIN_CONFIGS, TrainConfig
from deltas_nets.datasets.augment import Photometry
from deltas_nets.distill.labels import hard_labels
from deltas_nets.distill.superpoint import SuperPoint
from deltas_nets.distill.supervision import TeacherLabels
from deltas_nets.losses.losses import training_losses
from deltas_nets.losses.targets import detector_labels, keypoint_targets
from deltas_nets.network.deltas import Deltas
from deltas_nets.train.average import RunningAverage
from deltas_nets.train.batch_norm import Statistics
from deltas_nets.train.batches import Batch, BatchMaker
from deltas_nets.train.optimiser import make_optimizer
from deltas_nets.train.step import DEPTH_RANGE, Objective

HEIGHT, WIDTH, VIEWS, KEYPOINTS = 64, 96, 3, 40
NAMES = ("deltas-small", "deltas-vgg9", "deltas-resnet50")

SPREAD_KEYPOINTS = ["aten::_to_copy"]
"""A table from the host; CUDA takes it without waiting, other devices may not."""
SHI_TOMASI = ["tensor"]
"""kornia's Sobel filter, where no teacher labels the images."""


def config_of(name: str) -> TrainConfig:
    return dataclasses.replace(TRAIN_CONFIGS[name], num_keypoints=KEYPOINTS)


@cache
def model_of(name: str) -> Deltas:
    """Built on the host and moved, so that what no buffer holds is left behind."""
    return Deltas(config_of(name).network).to(DEVICE)


def at_most(copies: list[str], *known: list[str]) -> bool:
    """Is nothing copied that is not known to be?"""
    return Counter(copies) <= sum((Counter(names) for names in known), Counter())


def drawn(*shape: int) -> Tensor:
    return torch.rand(*shape, device=DEVICE)


def batch(num_rooms: int = 2) -> Batch:
    views = PosedViews(drawn(num_rooms, VIEWS, 3, 3), drawn(num_rooms, VIEWS, 4, 4))
    return Batch(
        images=drawn(num_rooms, VIEWS, 3, HEIGHT, WIDTH),
        views=views,
        true_views=views,
        depth=drawn(num_rooms, VIEWS, HEIGHT, WIDTH),
        shift=drawn(num_rooms, 2),
        anchors=drawn(num_rooms, 3, HEIGHT, WIDTH),
    )


def predict(model: Deltas, seen: Batch, **options: Any) -> Any:
    if model.config.matcher.kind == "joint":
        options["refinement"] = 2  # without it the number of samples is read from the device
    return model(
        seen.images,
        seen.views,
        DEPTH_RANGE,
        num_keypoints=KEYPOINTS,
        shift=seen.shift,
        **options,
    )


@pytest.mark.parametrize("name", NAMES)
def test_losses_and_gradients_are_made_on_the_device(name: str) -> None:
    config, model, seen = config_of(name), model_of(name).train(), batch()
    model.zero_grad()
    with one_device() as copies:
        losses = training_losses(
            predict(model, seen),
            seen.images,
            seen.true_views,
            seen.depth,
            config.loss,
            depth_range=DEPTH_RANGE,
        )
        losses.total.backward()
    assert on_device(losses)
    gradients = [parameter.grad for parameter in model.parameters()]
    assert all(gradient is not None for gradient in gradients) and on_device(gradients)
    assert at_most(copies, SPREAD_KEYPOINTS, SHI_TOMASI)


@pytest.mark.parametrize("name", NAMES)
def test_a_prediction_is_made_on_the_device(name: str) -> None:
    model, seen = model_of(name).eval(), batch()
    with one_device() as copies, torch.no_grad():
        prediction = predict(model, seen)
        confidence = prediction.confidence()
    assert on_device((prediction, confidence))
    assert at_most(copies, SPREAD_KEYPOINTS)


def test_a_step_of_the_weights_waits_for_nothing() -> None:
    config = config_of("deltas-vgg9")
    objective = Objective(model_of("deltas-vgg9").train(), config)
    optimizer, average = (
        make_optimizer(objective.model, config),
        RunningAverage(objective.model, 0.9),
    )
    seen = batch()._replace(labels=to_device(torch.zeros(2, 65, HEIGHT // 8, WIDTH // 8)))
    with one_device() as copies:
        statistics = Statistics(objective)
        total = sum(
            (objective(part).total for part in seen.split(2)), torch.zeros((), device=DEVICE)
        )
        total.backward()
        norm = nn.utils.clip_grad_norm_(objective.parameters(), 5.0, error_if_nonfinite=False)
        optimizer.step()
        average.update(objective.model, step=3)
        statistics.restore()
    assert on_device((norm, average.model.state_dict()))
    assert at_most(copies, 2 * SPREAD_KEYPOINTS)


def test_targets_are_made_on_the_device() -> None:
    seen = batch()
    with one_device() as copies:
        targets = keypoint_targets(
            seen.true_views, seen.depth, drawn(2, KEYPOINTS, 2), depth_range=DEPTH_RANGE
        )
    assert on_device(targets) and not copies
    with one_device() as copies:
        labels = detector_labels(seen.anchors)
    assert on_device(labels) and copies == SHI_TOMASI


def test_a_teacher_waits_for_nothing() -> None:
    teacher = TeacherLabels(SuperPoint(batch_norm=False).to(DEVICE))
    with one_device() as copies:
        labels = teacher(drawn(2, 3, HEIGHT, WIDTH)), hard_labels(drawn(2, 1, HEIGHT, WIDTH))
    assert on_device(labels) and not copies


@pytest.mark.parametrize("step", range(3))
def test_rooms_on_the_device_become_a_batch_there(step: int) -> None:
    config = TRAIN_CONFIGS["deltas-small"]
    rooms, data = config.batch_size, config.data
    views = PosedViews(drawn(rooms, data.num_views, 3, 3), drawn(rooms, data.num_views, 4, 4))
    images = drawn(rooms, data.num_views, 3, data.height, data.width).to(torch.uint8)
    depth = drawn(rooms, data.num_views, data.height, data.width)
    maker = BatchMaker(config)
    maker.photometry.forward = lambda images, *_, **__: images  # type: ignore[method-assign]
    with one_device():
        made = maker(PosedImages(images, views, depth), step)
    assert on_device(made)


@pytest.mark.parametrize("number", range(len(Photometry().steps)))
def test_light_is_changed_on_the_device_by_what_the_host_draws(number: int) -> None:
    change = Photometry().steps[number]
    change.p = 1.0
    with one_device():
        assert on_device(change(drawn(4, 3, HEIGHT, WIDTH)))
