"""A picture of a mesh, seen from beside a frame of its capture.

    deltas depth CAPTURE --views 5 --out maps
    deltas fuse CAPTURE maps --voxel 0.015 --out fused
    python benchmarks/mesh_picture.py fused/mesh.ply CAPTURE POSITION picture.jpg

POSITION is that of the frame in the capture. What is nearer than 1.7 units to the middle of its
image is drawn, turned by 23 degrees around it, as points of the surface; the nearest wins.
"""

import sys

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from deltas_nets import open_capture

SIZE, FOCAL, AROUND = (520, 900), 560.0, 1.7
YAW, PITCH, BACK = 0.4, 0.15, 0.3
POINTS = 7_000_000


def main() -> None:
    mesh = trimesh.load(sys.argv[1], process=False)
    capture = open_capture(sys.argv[2])
    frame = capture.frames.at(int(sys.argv[3]))
    turn, shift = frame.cam_from_world[:3, :3], frame.cam_from_world[:3, 3]
    local = np.asarray(mesh.vertices) @ turn.T + shift
    pixels = local @ frame.K.T
    beside = np.abs(pixels[:, :2] / pixels[:, 2:] - np.array(frame.image_size[::-1]) / 2)
    middle = np.median(local[(local[:, 2] > 0.3) & (beside < 40).all(axis=1)], axis=0)
    centres = np.asarray(mesh.triangles_center) @ turn.T + shift
    mesh.update_faces(np.linalg.norm(centres - middle, axis=1) < AROUND)
    points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=0)
    view = turned(YAW, PITCH)
    seen = (points @ turn.T + shift - middle) @ view.T + [0, 0, np.linalg.norm(middle) + BACK]
    normals = mesh.face_normals[faces] @ turn.T @ view.T
    colors = np.asarray(mesh.visual.vertex_colors)[mesh.faces[faces]][:, :, :3].mean(axis=1)
    shaded = colors * (0.8 + 0.2 * np.abs(normals[:, 2:]))
    height, width = SIZE
    place = np.rint(FOCAL * seen[:, :2] / seen[:, 2:] + [width / 2, height / 2]).astype(int)
    inside = (place >= 0).all(axis=1) & (place < [width, height]).all(axis=1)
    shown = inside & (seen[:, 2] > 0.05) & ((normals * seen).sum(axis=1) < 0)
    order = np.argsort(-seen[shown, 2])
    picture = np.full((height, width, 3), 255, dtype=np.uint8)
    column, row = place[shown][order].T
    picture[row, column] = shaded[shown][order].clip(0, 255)
    Image.fromarray(picture).filter(ImageFilter.MedianFilter(3)).save(sys.argv[4], quality=88)


def turned(yaw: float, pitch: float) -> NDArray[np.float64]:
    """A turn about y, then about x."""
    across = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    down = [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    return np.array(down) @ np.array(across)


if __name__ == "__main__":
    main()
