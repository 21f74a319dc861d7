"""ORB and SIFT, by scikit-image.

Both have many points in a cluster; what is nearer to a stronger one than the suppression's radius
is left out, as of every detector.

Sources: Rublee et al., ORB (2011); Lowe, Distinctive image features (2004).
"""

import numpy as np
import torch
from numpy.typing import NDArray
from skimage.feature import ORB, SIFT
from skimage.filters import difference_of_gaussians
from torch import Tensor

from deltas_nets.evaluate.detectors.features import DetectionConfig, Features, thinned

__all__ = ["orb", "sift"]

CANDIDATES = 500
"""Of ORB before suppression where no number is asked for: OpenCV's and scikit-image's default."""
SURPLUS = 8
"""Times the wanted points that ORB detects, as suppression leaves few of a cluster."""
CONTRAST, FAINT = 0.04 / 3, 0.004 / 3
"""Of SIFT: Lowe's, for three scales an octave, and where a number is asked for."""


def orb(image: Tensor, config: DetectionConfig) -> Features:
    """ORB's points and 256 bits, as numbers 0 and 1."""
    count = SURPLUS * config.num_points if config.num_points else CANDIDATES
    detector = ORB(n_keypoints=count)
    try:
        detector.detect_and_extract(image.mean(dim=0).double().numpy())
    except RuntimeError:  # not one corner
        return Features(torch.zeros(0, 2), torch.zeros(0, 256))
    pixels = torch.from_numpy(detector.keypoints[:, ::-1].copy()).float()
    strength = torch.from_numpy(detector.responses)
    kept = thinned(pixels, strength, (image.shape[-2], image.shape[-1]), config)
    bits = torch.from_numpy(detector.descriptors).float()
    return Features(pixels[kept], bits[kept])


def sift(image: Tensor, config: DetectionConfig) -> Features:
    """SIFT's points, a place with two orientations once, and 128 numbers of unit length."""
    grey = image.mean(dim=0).double().numpy()
    detector = SIFT(c_dog=FAINT if config.num_points else CONTRAST)
    try:
        detector.detect_and_extract(grey)
    except RuntimeError:  # not one extremum
        return Features(torch.zeros(0, 2), torch.zeros(0, 128))
    pixels = torch.from_numpy(detector.positions[:, ::-1].copy()).float()
    strength = torch.from_numpy(_contrast(grey, detector))
    kept = thinned(pixels, strength, (image.shape[-2], image.shape[-1]), config)
    descriptors = torch.from_numpy(detector.descriptors).float()
    return Features(pixels[kept], torch.nn.functional.normalize(descriptors[kept], dim=-1))


def _contrast(grey: NDArray[np.float64], detector: SIFT) -> NDArray[np.float64]:
    """Difference of Gaussians ``(N,)`` at each point and its scale: scikit-image keeps none."""
    contrast = np.zeros(len(detector.positions))
    rows, columns = detector.positions.round().astype(int).T
    places = np.stack([detector.octaves, detector.scales], axis=-1)
    for octave, scale in np.unique(places, axis=0):
        narrow, wide = detector.scalespace_sigmas[octave, scale : scale + 2]
        of_scale = (places == (octave, scale)).all(axis=-1)
        bands = difference_of_gaussians(grey, narrow, wide)
        contrast[of_scale] = np.abs(bands[rows[of_scale], columns[of_scale]])
    return contrast
