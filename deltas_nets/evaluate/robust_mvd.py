"""A network as the Robust MVD benchmark runs it: poses given, no range of depth, no alignment.

The benchmark's own program (the package ``rmvd``, which this file does not need) asks a model for
three things, in turn: ``sample = model.input_adapter(...)``, ``output = model(**sample)``,
``pred, aux = model.output_adapter(output)``. :class:`RobustMvdModel` has them.

Source: Schroeppel et al., A benchmark and a baseline for robust multi-view depth estimation (2022).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deltas_nets.captures.frame import Frame
from deltas_nets.evaluate.depth_metrics import depth_metrics
from deltas_nets.evaluate.scores import resize_nearest
from deltas_nets.evaluate.sparsification import ause
from deltas_nets.predict.depth_map import DepthMap, PredictConfig, resized
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import Predictor, load_predictor
from deltas_nets.predict.reach import ROOM, Reach
from deltas_nets.predict.search import settled

__all__ = ["RobustMvdMetrics", "RobustMvdModel", "robust_mvd_metrics"]

Array = NDArray[Any]


class RobustMvdMetrics(NamedTuple):
    """What the benchmark ranks by, of one map.

    Attributes:
        rel: mean relative error, per cent.
        tau: share of the pixels whose depth is right by a factor below 1.03, per cent.
        ause: area under the sparsification error; NaN where no uncertainty is stated.
    """

    rel: float
    tau: float
    ause: float


@dataclass(frozen=True, eq=False)
class _ArrayFrame(Frame):
    """A frame whose image is in memory."""

    pixels: Array = field(kw_only=True)
    """``(H, W, 3)`` uint8."""

    def read_image(self) -> NDArray[np.uint8]:
        return self.pixels


class RobustMvdModel:
    """A network of deltas, or any that `deltas evaluate` knows, by the benchmark's interface.

    Args:
        weights: as for `deltas evaluate --weights`.
        device: of torch.
        config: of the prediction; its range is not used.

    Example:
        >>> model = RobustMvdModel()
        >>> images = [np.zeros((1, 3, 48, 64), np.float32) for _ in range(2)]
        >>> poses = [np.eye(4)[None], np.eye(4)[None]]
        >>> poses[1] = poses[1] - np.pad([[[0.1]]], ((0, 0), (0, 3), (3, 0)))
        >>> K = np.array([[[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]])
        >>> sample = model.input_adapter(images, np.array([0]), poses, [K, K])
        >>> pred, aux = model.output_adapter(model(**sample))
        >>> pred["depth"].shape, pred["depth_uncertainty"].shape
        ((1, 1, 48, 64), (1, 1, 48, 64))
    """

    name = "deltas"

    def __init__(
        self,
        weights: str | Path = "deltas-small",
        device: str = "cpu",
        config: PredictConfig | None = None,
    ) -> None:
        self.predictor: Predictor = load_predictor(weights, device)
        self.config = config or PredictConfig()
        self._number = count()

    def input_adapter(
        self,
        images: Sequence[Array],
        keyview_idx: ArrayLike,
        poses: Sequence[Array] | None = None,
        intrinsics: Sequence[Array] | None = None,
        depth_range: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> dict[str, Any]:
        """The benchmark's arrays as keyword arguments of a call.

        Args:
            images: of each view ``(N, 3, H, W)``, 0 to 255, RGB.
            keyview_idx: ``(N,)`` which view's depth is wanted.
            poses: of each view ``(N, 4, 4)``, from the key view's camera to the view's, metres.
            intrinsics: of each view ``(N, 3, 3)`` for its image.
            depth_range: nearest and farthest depth, ``(N,)`` each, metres; the benchmark gives none
                in its absolute track, and the network looks for itself then.

        Raises:
            ValueError: poses or intrinsics are missing, from which depth follows, or there is no
                such key view.
        """
        if poses is None or intrinsics is None:
            raise ValueError("deltas triangulates: poses and intrinsics must be given")
        if not len(images) == len(poses) == len(intrinsics):
            numbers = f"{len(images)}, {len(poses)}, {len(intrinsics)}"
            raise ValueError(
                f"images, poses and intrinsics must be of as many views, got {numbers}"
            )
        keys = np.atleast_1d(np.asarray(keyview_idx))
        if not np.isin(keys, range(len(images))).all():
            raise ValueError(f"keyview_idx must be in 0..{len(images) - 1}, got {keys.tolist()}")
        return {
            "images": [np.asarray(image) for image in images],
            "keyview_idx": keys.astype(int),
            "poses": [np.asarray(pose, dtype=np.float64) for pose in poses],
            "intrinsics": [np.asarray(K, dtype=np.float64) for K in intrinsics],
            "depth_range": depth_range,
        }

    def __call__(
        self,
        images: Sequence[Array],
        keyview_idx: Array,
        poses: Sequence[Array],
        intrinsics: Sequence[Array],
        depth_range: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> dict[str, Array]:
        """Depth of the key views.

        Returns:
            ``depth`` ``(N, 1, H, W)`` metres, 0 where there is none, and, of networks that state a
            deviation, ``depth_uncertainty``: the standard deviation as a share of the depth.
        """
        found = []
        for item, key in enumerate(keyview_idx):
            order = [int(key), *(view for view in range(len(images)) if view != key)]
            frames = [
                self._frame(images[view][item], intrinsics[view][item], poses[view][item])
                for view in order
            ]
            ends = None
            if depth_range is not None:
                near, far = (np.broadcast_to(end, len(keyview_idx))[item] for end in depth_range)
                ends = Reach(float(near), float(far))
            found.append(self._map(frames, ends))
        output = {"depth": np.stack([each.depth[None] for each in found])}
        deviations = [_deviation(each) for each in found]
        if all(deviation is not None for deviation in deviations):
            output["depth_uncertainty"] = np.stack(
                [each[None] for each in deviations if each is not None]
            )
        return output

    def output_adapter(
        self, model_output: Mapping[str, Array]
    ) -> tuple[dict[str, Array], dict[str, Array]]:
        """What the benchmark reads: the prediction, and nothing besides."""
        return dict(model_output), {}

    def _map(self, frames: Sequence[Frame], ends: Reach | None) -> DepthMap:
        def looked(reach: Reach) -> DepthMap:
            return look(self.predictor, frames, self.config, reach)

        if ends is not None:
            return looked(ends)
        return settled(looked, Reach(*ROOM), sure=True, metric=True).map

    def _frame(self, image: Array, K: Array, pose: Array) -> Frame:
        # A name of its own for every image: what is encoded is remembered by it.
        name = str(next(self._number))
        pixels = np.rint(image.transpose(1, 2, 0)).clip(0, 255).astype(np.uint8)
        size = (pixels.shape[0], pixels.shape[1])
        return _ArrayFrame(name, Path("sample") / name, size, K, pose, pixels=pixels)


def robust_mvd_metrics(
    depth: ArrayLike, truth: ArrayLike, uncertainty: ArrayLike | None = None
) -> RobustMvdMetrics | None:
    """The benchmark's metrics of a map: at the truth's size, at all pixels with true depth.

    Args:
        depth: ``(H, W)`` metres, 0 where there is none.
        truth: ``(h, w)`` metres, 0 where unknown.
        uncertainty: ``(H, W)``, anything that grows with the relative error that is expected.

    Returns:
        None where no true depth is known.

    Example:
        >>> robust_mvd_metrics([[2.0, 2.2]], [[2.0, 2.0]])
        RobustMvdMetrics(rel=5.0..., tau=50.0, ause=nan)
    """
    true = np.asarray(truth, dtype=np.float32)
    size = (true.shape[0], true.shape[1])
    every = (float(np.finfo(np.float32).tiny), float("inf"))
    at_truth = resize_nearest(np.asarray(depth, dtype=np.float32), size)
    found = depth_metrics(at_truth, true, depth_range=every)
    if found is None:
        return None
    area = float("nan")
    if uncertainty is not None:
        stated = resize_nearest(np.asarray(uncertainty, dtype=np.float32), size)
        area = ause(at_truth, stated, true, depth_range=every)
    return RobustMvdMetrics(100 * found.abs_rel, 100 * found.delta103, area)


def _deviation(found: DepthMap) -> Array | None:
    if found.log_std is None:
        return None
    size = (found.depth.shape[0], found.depth.shape[1])
    return np.exp(resized(found.log_std, size))
