"""Does the predicted standard deviation tell how wrong a depth map is?

Two questions. Sparsification asks for the order: how much smaller is the error of the half of a
map that the network is most certain of? Calibration asks for the size: among pixels that are given
the same standard deviation, is the error that large?

Sources: Ilg et al., Uncertainty estimates and multi-hypotheses networks for optical flow (2018),
for sparsification; Guo et al., On calibration of modern neural networks (2017), for comparing
groups of equal prediction.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

LOG_STD = (-10.0, 5.0)
"""Log relative standard deviations that the bins span; what is beyond is in the outermost."""
NUM_BINS = 1500
COLUMNS = ("count", "std", "absolute", "squared", "relative")


class Decile(NamedTuple):
    """Pixels of similar predicted standard deviation.

    The error is that of log depth: to first order the relative error, the same for twice and half
    the depth, and what the network's spread describes. Its size is stated in two ways, which are
    equal for the Laplace distribution that the network predicts:

    - the root mean square is the standard deviation's definition. Where a few pixels are badly
      wrong (a surface mirrors the room and the map shows what it mirrors) they alone decide it:
      one per cent of the pixels can carry nearly half of the sum, and one room in sixty a decile;
    - sqrt(2) times the mean absolute error is the estimate of greatest likelihood if errors are
      Laplace-distributed, and stable; of normal errors it is 1.13 times the first.

    A tail that is heavier than Laplace's makes the first larger than the second; no standard
    deviation meets both then, so both are shown. Calibration goes by the second.

    Attributes:
        std: mean predicted standard deviation, relative to depth.
        rms: root mean square of the error.
        laplace: sqrt(2) times the mean absolute error.
    """

    std: float
    rms: float
    laplace: float

    @property
    def rms_ratio(self) -> float:
        """True over predicted: above 1 the network is too sure of itself."""
        return self.rms / self.std

    @property
    def laplace_ratio(self) -> float:
        """Likewise from the mean absolute error."""
        return self.laplace / self.std


class Sparsification(NamedTuple):
    """Abs Rel of everything and of the half that is most certain.

    Per map, every map keeps its own half, as users keep pixels of a map, and means are over maps,
    as those of the depth metrics. Pooled, the half is of all maps' pixels together: it may leave
    out most of a bad map, so its ratio also says whether bad maps are known to be bad.

    Attributes:
        every: of all pixels with true depth, mean over maps.
        half: of the half of each map with the smaller predicted relative standard deviations.
        pooled_every: of the pixels of all maps.
        pooled_half: of the half of them with the smaller standard deviations.
    """

    every: float
    half: float
    pooled_every: float
    pooled_half: float

    @property
    def ratio(self) -> float:
        """0.5 where the certain half has half of the error; 1 where the order says nothing."""
        return self.half / self.every if self.every > 0 else float("nan")

    @property
    def pooled_ratio(self) -> float:
        """The ratio of all maps' pixels together."""
        return self.pooled_half / self.pooled_every if self.pooled_every > 0 else float("nan")


class Calibration(NamedTuple):
    """What is known of a network's uncertainty after many maps.

    Attributes:
        sparsification: does the order mean anything?
        deciles: ten groups of equally many pixels of all maps, the most certain first.
        pixels: how many there were.
    """

    sparsification: Sparsification
    deciles: tuple[Decile, ...]
    pixels: int


class CalibrationMeter:
    """Takes maps one by one; its memory does not grow with their number.

    Sums are kept in bins of the log of the predicted standard deviation, 1 % wide, so that groups
    of equally many pixels can be formed afterwards.

    Example:
        >>> meter = CalibrationMeter()
        >>> truth = np.full((4, 4), 2.0)
        >>> meter.add(1.1 * truth, np.full((4, 4), 0.1), truth)
        >>> round(meter.result().deciles[0].rms, 3)
        0.095
    """

    def __init__(self) -> None:
        self._sums = np.zeros((len(COLUMNS), NUM_BINS))
        self._abs_rel = np.zeros(2)  # every, half
        self._maps = 0

    def add(
        self,
        depth: ArrayLike,
        relative_std: ArrayLike,
        truth: ArrayLike,
        *,
        depth_range: tuple[float, float] = (0.5, 10.0),
    ) -> None:
        """Take in a map; one without true depth in range changes nothing.

        Args:
            depth: any shape, metres; 0, negative or not finite is no prediction.
            relative_std: its standard deviation, a share of the depth, positive.
            truth: metres; 0 is unknown.
            depth_range: (near, far) of the true depth that counts, metres.

        Raises:
            ValueError: shapes differ.
        """
        p, s, g = (np.asarray(a, dtype=np.float64) for a in (depth, relative_std, truth))
        if not p.shape == s.shape == g.shape:
            raise ValueError(f"shapes differ: {p.shape}, {s.shape}, {g.shape}")
        used = np.isfinite(p) & (p > 0) & np.isfinite(s) & (s > 0)
        used &= np.isfinite(g) & (g >= depth_range[0]) & (g <= depth_range[1])
        if not used.any():
            return
        p, s, g = p[used], s[used], g[used]
        error = np.log(p / g)
        near, far = LOG_STD
        place = (np.log(s) - near) / (far - near) * NUM_BINS
        index = place.clip(0, NUM_BINS - 1).astype(int)
        relative = np.abs(p - g) / g
        for row, values in enumerate((np.ones_like(s), s, np.abs(error), error**2, relative)):
            self._sums[row] += np.bincount(index, values, minlength=NUM_BINS)
        # A map of one pixel has no half: it is kept.
        certain = np.argsort(s, kind="stable")[: max(1, len(s) // 2)]
        self._abs_rel += relative.mean(), relative[certain].mean()
        self._maps += 1

    def take(self, other: "CalibrationMeter") -> None:
        """Take in all maps of another meter."""
        self._sums += other._sums
        self._abs_rel += other._abs_rel
        self._maps += other._maps

    @property
    def empty(self) -> bool:
        """No map had true depth in range."""
        return self._maps == 0

    def result(self) -> Calibration:
        """What the maps so far say.

        Raises:
            ValueError: no map had true depth in range.
        """
        if self.empty:
            raise ValueError("no depth map has true depth in range")
        every, half = (self._abs_rel / self._maps).tolist()
        groups = self.groups(10)
        rms, laplace = groups.rms, groups.laplace
        deciles = tuple(map(Decile, groups.std.tolist(), rms.tolist(), laplace.tolist()))
        pooled = self.groups(2).relative
        order = Sparsification(every, half, float(pooled.mean()), float(pooled[0]))
        return Calibration(order, deciles, round(self._sums[0].sum()))

    def groups(self, number: int) -> "Groups":
        """Equally many pixels of all maps in each group, the most certain first.

        A bin that two groups meet in is divided between them in proportion.
        """
        total = np.cumsum(self._sums, axis=1)
        total = np.concatenate([np.zeros((len(COLUMNS), 1)), total], axis=1)
        cuts = np.linspace(0, total[0, -1], number + 1)
        parts = np.stack([np.diff(np.interp(cuts, total[0], column)) for column in total])
        std, absolute, squared, relative = parts[1:] / parts[0]
        return Groups(std, np.sqrt(squared), 2**0.5 * absolute, relative)


class Groups(NamedTuple):
    """What a :class:`Decile` says, for any number of groups: arrays ``(number,)``.

    Attributes:
        std: mean predicted relative standard deviation.
        rms: root mean square error of log depth.
        laplace: sqrt(2) times the mean absolute error of log depth.
        relative: Abs Rel.
    """

    std: NDArray[np.float64]
    rms: NDArray[np.float64]
    laplace: NDArray[np.float64]
    relative: NDArray[np.float64]
