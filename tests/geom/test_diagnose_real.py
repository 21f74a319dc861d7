"""``diagnose`` on real captures, matched by SIFT: faults are named, clean ones raise no alarm."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from diagnosis_cases import NAMED, Capture, Fault, concerned, diagnosed

from deltas_geom import invert_pose
from deltas_geom.diagnosis.causes import Cause


@pytest.fixture(scope="module", params=["hololens", "sevenscenes_reg"])
def real(request: pytest.FixtureRequest, shared_data: Path) -> list[Capture]:
    """View sets matched by SIFT, with the mismatches that it has."""
    cv2 = pytest.importorskip("cv2")
    folder = shared_data / request.param
    intrinsics = np.loadtxt(folder / "intrinsic" / "intrinsic_color.txt")[:3, :3]
    sets = json.loads((folder / "view_sets.json").read_text())
    found = []
    for views in (sets[0], sets[len(sets) // 2]):
        names = [views["anchor"], *views["sources"]]
        poses = np.stack([np.loadtxt(folder / "pose" / f"{name}.txt") for name in names])
        images = [cv2.imread(str(folder / "color" / f"{name}.jpg"), 0) for name in names]
        places, descriptors = zip(
            *(cv2.SIFT_create(1500).detectAndCompute(image, None) for image in images), strict=True
        )
        pixels = np.full((len(names), len(places[0]), 2), np.nan)
        pixels[0] = [place.pt for place in places[0]]
        for view in range(1, len(names)):
            for best, second in cv2.BFMatcher().knnMatch(descriptors[0], descriptors[view], k=2):
                if best.distance < 0.8 * second.distance:
                    pixels[view, best.queryIdx] = places[view][best.trainIdx].pt
        K = torch.from_numpy(intrinsics).expand(len(names), 3, 3)
        cam_from_world = invert_pose(torch.from_numpy(poses))
        found.append((K, cam_from_world, torch.from_numpy(pixels)))
    return found


@pytest.mark.shared
def test_real_captures_raise_no_alarm(real: list[Capture]) -> None:
    for capture in real:
        found = diagnosed(capture)
        assert found.well and found.residual_as_given < 1.0, str(found)


@pytest.mark.shared
@NAMED
def test_faults_of_real_captures_are_named(
    whose: str, cause: Cause, fault: Fault, real: list[Capture]
) -> None:
    for capture in real:
        found = diagnosed(fault(*capture))
        assert found.cause is cause and found.cameras == concerned(whose, cause), str(found)
