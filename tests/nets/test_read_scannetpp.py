"""ScanNet++ as it is downloaded: a model and a transforms.json beside two folders of images."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from written_captures import CX, CY, NUM, OPENGL, F, make_scene, write_image

from deltas_nets.captures.frame import Lens
from deltas_nets.captures.opening import open_capture
from deltas_nets.errors import UserError

LENS = (0.01, -0.02, 0.003, 0.0)


@pytest.fixture
def dslr(tmp_path: Path) -> Path:
    folder, scene = tmp_path / "0a5c013435" / "dslr", make_scene()
    rows, frames = [], []
    for i, (pose, image) in enumerate(zip(scene.world_from_cam, scene.images, strict=True)):
        name = f"DSC{1000 + i:05d}.JPG"
        write_image(folder / "resized_images" / name, image)
        write_image(folder / "resized_undistorted_images" / name, 255 - image)
        write_image(folder / "resized_anon_masks" / name.replace("JPG", "png"), image)
        inverse = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        numbers = " ".join(f"{number:.17g}" for number in (w, x, y, z, *inverse[:3, 3]))
        rows.append(f"{i + 1} {numbers} 1 {name}\n\n")
        frames.append({"file_path": name, "transform_matrix": (pose @ OPENGL).tolist()})
    (folder / "colmap").mkdir()
    (folder / "colmap/images.txt").write_text("".join(rows))
    camera = " ".join(map(str, (F, F, CX + 0.5, CY + 0.5, *LENS)))
    (folder / "colmap/cameras.txt").write_text(f"1 OPENCV_FISHEYE 64 48 {camera}\n")
    (folder / "colmap/points3D.txt").write_text("")
    said = {"fl_x": F, "fl_y": F, "cx": CX + 0.5, "cy": CY + 0.5, "w": 64, "h": 48}
    said |= {f"k{i + 1}": k for i, k in enumerate(LENS)}
    (folder / "nerfstudio").mkdir()
    content = {**said, "camera_model": "OPENCV_FISHEYE"}
    content |= {"frames": frames[:-1], "test_frames": frames[-1:]}
    (folder / "nerfstudio/transforms.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("part", ["colmap", "nerfstudio"])
def test_images_are_those_with_the_lens(dslr: Path, part: str) -> None:
    capture, scene = open_capture(dslr / part), make_scene()
    assert len(capture.frames) == NUM and not capture.lost
    for frame, pose in zip(capture.frames.values(), scene.cam_from_world, strict=True):
        assert frame.image_path.parent == dslr / "resized_images"
        assert frame.lens == Lens("OPENCV_FISHEYE", LENS)
        np.testing.assert_allclose(frame.cam_from_world, pose, atol=1e-9)


def test_both_are_named(dslr: Path) -> None:
    with pytest.raises(UserError, match="2 captures") as error:
        open_capture(dslr)
    assert str(dslr / "colmap") in error.value.remedy
