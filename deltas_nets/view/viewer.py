"""What the viewer shows, and the switches beside it."""

import io
import math
import socket
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.spread import spread
from deltas_nets.captures.upright import up_of
from deltas_nets.errors import UserError
from deltas_nets.extras import check_extra
from deltas_nets.page.maps import Maps
from deltas_nets.page.pictures import size_within
from deltas_nets.page.scene import (
    SURE,
    Camera,
    Layer,
    SurePoints,
    camera_of,
    fused_layers,
    points_of_maps,
    sparse_layer,
)

if TYPE_CHECKING:
    from viser import ViserServer

__all__ = ["check_address", "check_viewer", "open_viewer"]

MOST_POINTS, MOST_FACES = 400_000, 400_000
MOST_IMAGES, IMAGE_LONGEST = 200, 160
"""Frames whose images are shown, and pixels of their longer side."""
SMALLEST = 1e-6
CAMERA_BLUE = (86, 138, 242)


def check_viewer() -> None:
    """Is the package installed that the viewer needs?

    Raises:
        UserError: it is not.
    """
    check_extra("view", "viser", wanted_by="the viewer needs", where="deltas view")


def check_address(host: str) -> None:
    """Can this machine serve there? viser tries one port after another for ever where it cannot.

    Raises:
        UserError: it has no such address.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, protocol) as attempt:
            attempt.bind(address)
    except (OSError, UnicodeError) as error:
        what = "this machine has no such address"
        remedy = "give 127.0.0.1 for this machine alone, or 0.0.0.0 for all that reach it"
        raise UserError(what, f"--host {host}", remedy) from error


def open_viewer(
    capture: Capture, maps: Maps | None, *, host: str = "127.0.0.1", port: int = 8080
) -> "ViserServer":
    """Serve a capture: its cameras and sparse points and, of maps, their points and what was fused.

    Args:
        capture: the frames.
        maps: what `deltas depth` wrote of it, in which case ``maps.capture`` is shown.
        host: who may look: this machine alone, or 0.0.0.0 for all.
        port: where; the next one that is free if it is not.

    Returns:
        The server, which works until it is stopped.

    Raises:
        UserError: viser is not installed, or a file cannot be read.
    """
    check_viewer()
    if maps is not None:
        capture = maps.capture
    shown = capture.frames if maps is None else maps.ids
    cameras = [camera_of(capture.frame(id)) for id in shown]
    centres = np.array([camera.world_from_cam[:3, 3] for camera in cameras])
    # Browsers compute in float32: what is shown is around the middle of the cameras.
    origin = np.median(centres, axis=0)
    images = _images(capture, [camera.id for camera in cameras])
    fused: list[Layer] = []
    points = None
    if maps is not None:
        fused = fused_layers(maps, most_points=MOST_POINTS, most_faces=MOST_FACES)
        points = _fewer(points_of_maps(maps))
        points = points if len(points.confidence) else None
    sparse = sparse_layer(capture, most_points=MOST_POINTS)
    clouds = [layer.surface.xyz for layer in fused]
    clouds += [] if points is None else [points.surface.xyz]
    clouds += [] if sparse is None else [sparse.surface.xyz]

    from viser import ViserServer

    with redirect_stdout(io.StringIO()):  # it has a banner of its own
        server = ViserServer(host=host, port=port, label=capture.path.resolve().name, verbose=False)
    box = _box([*clouds, centres]) - origin
    reach = max(float(np.linalg.norm(box[1] - box[0])), SMALLEST)
    _look(server, up_of(capture), cameras, box, reach)
    server.gui.add_markdown(_words(capture, maps))
    # One thing is shown at first: a mesh, else points of the maps, else what the capture has.
    for layer in fused:
        _show(server, layer, origin, reach, shown=layer is fused[0])
    if points is not None:
        _show_points_of_maps(server, points, origin, reach, shown=not fused)
    if sparse is not None:
        _show(server, sparse, origin, reach, shown=not fused and points is None)
    _show_cameras(server, cameras, images, origin, reach)
    return server


def _images(capture: Capture, ids: list[str]) -> dict[str, NDArray[np.uint8]]:
    """Small images of some frames."""
    frames = map(capture.frame, spread(ids, MOST_IMAGES))
    return {f.id: f.read_resized(size_within(f.image_size, IMAGE_LONGEST)) for f in frames}


def _words(capture: Capture, maps: Maps | None) -> str:
    told = f"{len(capture.frames)} frames"
    if maps is None:
        return told
    said = maps.summary.get("verdict")
    return f"{told}, {len(maps.ids)} maps" + (f": {said}" if isinstance(said, str) else "")


def _fewer(points: SurePoints) -> SurePoints:
    some = slice(None, None, -(-len(points.confidence) // MOST_POINTS) or 1)
    surface = points.surface
    return SurePoints(
        surface._replace(xyz=surface.xyz[some], rgb=surface.rgb[some]), points.confidence[some]
    )


def _box(clouds: list[NDArray[np.float64]]) -> FloatArray:
    """``(2, 3)`` corners of a box around most of what there is."""
    boxes = [np.percentile(xyz, (5, 95), axis=0) for xyz in clouds]
    return np.array([np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))])


def _look(
    server: "ViserServer", up: FloatArray, cameras: list[Camera], box: FloatArray, reach: float
) -> None:
    """At first from above, behind the cameras, so that what they see is not hidden by a wall."""
    ahead = np.mean([camera.world_from_cam[:3, 2] for camera in cameras], axis=0)
    away = 0.5 * up - (ahead - (ahead @ up) * up)
    server.scene.set_up_direction(up)
    server.initial_camera.up = up
    server.initial_camera.look_at = box.mean(axis=0)
    server.initial_camera.position = box.mean(axis=0) + reach * away / np.linalg.norm(away)


def _switch(server: "ViserServer", name: str, handles: list[Any], *, shown: bool = True) -> None:
    """A box that shows some things, or hides them."""
    box = server.gui.add_checkbox(name, shown)

    @box.on_update
    def _(_: Any) -> None:
        for handle in handles:
            handle.visible = box.value


def _show(
    server: "ViserServer", layer: Layer, origin: FloatArray, reach: float, *, shown: bool
) -> None:
    name, (xyz, rgb, faces) = f"/{layer.name}", layer.surface
    if faces is None:
        handle: Any = server.scene.add_point_cloud(
            name,
            (xyz - origin).astype(np.float32),
            rgb,
            point_size=0.002 * reach,
            point_shape="circle",
            precision="float32",
            visible=shown,
        )
    else:
        import trimesh

        mesh = trimesh.Trimesh(xyz - origin, faces, vertex_colors=rgb, process=False)
        handle = server.scene.add_mesh_trimesh(name, mesh, visible=shown)
    _switch(server, layer.name, [handle], shown=shown)


def _show_points_of_maps(
    server: "ViserServer", points: SurePoints, origin: FloatArray, reach: float, *, shown: bool
) -> None:
    """Points of the maps, with sliders of their size and of the least confidence."""
    xyz, rgb = (points.surface.xyz - origin).astype(np.float32), points.surface.rgb

    def sure(least: float) -> NDArray[np.bool_]:
        chosen: NDArray[np.bool_] = points.confidence >= least
        return chosen

    chosen = sure(SURE)
    handle = server.scene.add_point_cloud(
        "/points of the maps",
        xyz[chosen],
        rgb[chosen],
        point_size=0.002 * reach,
        point_shape="circle",
        precision="float32",
        visible=shown,
    )
    _switch(server, "points of the maps", [handle], shown=shown)
    least = server.gui.add_slider("least confidence", 0.0, 1.0, 0.05, SURE)
    size = server.gui.add_slider("size of points", 0.2, 3.0, 0.1, 1.0)

    @least.on_update
    def _(_: Any) -> None:
        chosen = sure(least.value)
        with server.atomic():
            handle.points, handle.colors = xyz[chosen], rgb[chosen]

    @size.on_update
    def _(_: Any) -> None:
        handle.point_size = 0.002 * reach * size.value


def _show_cameras(
    server: "ViserServer",
    cameras: list[Camera],
    images: dict[str, NDArray[np.uint8]],
    origin: FloatArray,
    reach: float,
) -> None:
    """Cameras with their images; a click looks through one."""
    from viser.transforms import SO3

    told: Any = server.gui.add_text("frame", "click a camera", disabled=True)
    handles = []
    for number, camera in enumerate(cameras):
        left, top, right, bottom = camera.slopes
        # By number: an id may hold slashes, which stand for parents here.
        handle = server.scene.add_camera_frustum(
            f"/cameras/{number}",
            fov=2 * math.atan((bottom - top) / 2),
            aspect=(right - left) / (bottom - top),
            scale=0.02 * reach,
            thickness=1.5,
            thickness_units="screen",
            color=CAMERA_BLUE,
            image=images.get(camera.id),
            wxyz=SO3.from_matrix(camera.world_from_cam[:3, :3]).wxyz,
            position=camera.world_from_cam[:3, 3] - origin,
        )
        handles.append(handle)

        @handle.on_click
        def _(event: Any, id: str = camera.id, seen: Any = handle) -> None:
            told.value = id
            event.client.camera.wxyz, event.client.camera.position = seen.wxyz, seen.position

    _switch(server, "cameras", handles)
    scale = server.gui.add_slider("size of cameras", 0.2, 3.0, 0.1, 1.0)

    @scale.on_update
    def _(_: Any) -> None:
        for handle in handles:
            handle.scale = 0.02 * reach * scale.value
