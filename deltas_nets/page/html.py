"""The page as one HTML file: what is shown, packed beside the style and the program."""

import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from decimal import Decimal
from importlib.resources import files
from statistics import mean
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets import __version__
from deltas_nets.captures.upright import up_of
from deltas_nets.evaluate.depth_metrics import DepthMetrics, mean_metrics
from deltas_nets.outputs.beside import mark_of_page
from deltas_nets.outputs.verdict import verdict
from deltas_nets.page.colours import NONE, Scale, lookup_table, ticks_of
from deltas_nets.page.maps import Maps
from deltas_nets.page.pictures import FramePictures, jpeg, scales_of
from deltas_nets.page.scene import Camera, Layer, camera_of
from deltas_nets.terminal import counted

__all__ = ["ShownFrame", "bytes_of_frame", "bytes_of_layer", "html_of", "shown_frame"]

KINDS = {
    "image": "Image",
    "depth": "Depth",
    "confidence": "Confidence",
    "error": "Error",
    "truth": "Sensor depth",
}
"""Pictures, in the order of the page."""
STEPS = 65535
"""Steps of a coordinate within the box of its layer."""


class ShownFrame(NamedTuple):
    """A frame as the page holds it.

    Attributes:
        id: of the frame.
        jpegs: files by kind.
        score: against sensor depth; None where there is none.
    """

    id: str
    jpegs: Mapping[str, bytes]
    score: DepthMetrics | None


def shown_frame(frame: FramePictures) -> ShownFrame:
    """A frame as the page holds it."""
    jpegs = {kind: jpeg(picture, kind) for kind, picture in frame.pictures.items()}
    return ShownFrame(frame.id, jpegs, frame.score)


def bytes_of_frame(frame: ShownFrame) -> int:
    """What a frame adds to the page."""
    return 600 + sum(_encoded(len(file)) for file in frame.jpegs.values())


def bytes_of_layer(layer: Layer) -> int:
    """What a layer adds to the page."""
    faces = 0 if layer.surface.faces is None else len(layer.surface.faces)
    return 300 + _encoded(9 * len(layer.surface.xyz) + 12 * faces)


def html_of(
    maps: Maps,
    frames: Sequence[ShownFrame],
    layers: Sequence[Layer],
    scale: Scale,
    depth_range: tuple[float, float],
) -> bytes:
    """The page.

    Args:
        maps: of the capture.
        frames: that are shown, at least one.
        layers: to be seen in three dimensions.
        scale: of depth.
        depth_range: (near, far) of the true depth that counted, metres.
    """
    shown = {kind for frame in frames for kind in frame.jpegs}
    data = {
        "name": maps.capture.path.resolve().name,
        "verdict": _verdict(maps),
        "facts": _facts(maps, frames, scale, depth_range),
        "notes": _notes(maps, frames),
        "kinds": {kind: name for kind, name in KINDS.items() if kind in shown},
        "scales": {kind: _scale(scale) for kind, scale in scales_of(scale).items()},
        "none": NONE,
        "frames": [_frame(maps, frame) for frame in frames],
        "scene": _scene(maps, frames, layers),
        "version": __version__,
    }
    # Ids are the user's: "</script>" in one would end the data.
    text = json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
    page = _asset("page.html")
    for name, content in (
        ("<!--mark-->", mark_of_page(depth_range)),
        ("/*style*/", _asset("page.css")),
        ("/*program*/", _asset("scene.js") + _asset("page.js")),
        ("/*data*/", text),
    ):
        page = page.replace(name, content, 1)
    return page.encode("utf-8", "replace")


def _asset(name: str) -> str:
    return files("deltas_nets.page").joinpath(name).read_text(encoding="utf-8")


def _encoded(count: int) -> int:
    return 4 * -(-count // 3)


def _base64(content: bytes | NDArray[np.generic]) -> str:
    return b64encode(content if isinstance(content, bytes) else content.tobytes()).decode("ascii")


def _verdict(maps: Maps) -> dict[str, Any]:
    records = [_numbers(maps.record(id)) for id in maps.ids]
    short = maps.summary.get("sets_short_of_views")
    said = verdict(records, short=short if isinstance(short, int) else 0)
    return {"line": said.line, "doubtful": said.doubtful}


def _numbers(record: Mapping[str, Any]) -> dict[str, float]:
    """What a verdict reads, of a summary that may be of another version."""
    names = (
        *("confidence", "network_confidence", "valid_points", "keypoints", "seconds"),
        "measured_factor",
    )
    found = {name: record[name] for name in names if isinstance(record.get(name), int | float)}
    if "valid_points" not in found:
        found.pop("keypoints", None)
    return found


def _facts(
    maps: Maps, frames: Sequence[ShownFrame], scale: Scale, depth_range: tuple[float, float]
) -> list[tuple[str, str, str]]:
    """Names, values and explanations of what is said of the whole."""
    records = [_numbers(maps.record(id)) for id in maps.ids]
    sure = [record["confidence"] for record in records if "confidence" in record]
    seconds = [record["seconds"] for record in records if "seconds" in record]
    shares = [r["valid_points"] / r["keypoints"] for r in records if r.get("keypoints", 0) > 0]
    facts = [("Maps", f"{len(maps.ids)}", "depth maps in the folder")]
    if sure:
        told = "probability that a depth is within 5 %, mean"
        facts.append(("Confidence", f"{mean(sure):.2f}", told))
    if shares:
        told = "keypoints that were triangulated, mean"
        facts.append(("Points", f"{100 * mean(shares):.0f} %", told))
    told = "of most pixels: 98 % of them"
    facts.append(("Depth", f"{_short(scale.low)} to {_short(scale.high)} {scale.unit}", told))
    scores = [frame.score for frame in frames if frame.score is not None]
    scores = [score for score in scores if score.coverage > 0]
    if scores:
        whole = mean_metrics(scores)
        told = f"of {len(scores)} maps, where the sensor says {depth_range[0]:g} to "
        told += f"{depth_range[1]:g} m"
        facts.append(("Abs Rel", f"{whole.abs_rel:.3f}", f"mean relative error {told}"))
        facts.append(("δ < 1.25", f"{whole.delta1:.3f}", f"share of pixels {told}"))
    if seconds:
        facts.append(("Time", f"{mean(seconds):.2f} s", "a map, mean"))
    return facts


def _notes(maps: Maps, frames: Sequence[ShownFrame]) -> list[str]:
    notes = []
    if len(frames) < len(maps.ids):
        notes.append(
            f"{len(frames)} of {len(maps.ids)} maps are shown here, evenly spread, so that the "
            "page stays small; preview/ has all of them."
        )
    if maps.missing:
        notes.append(f"{counted(len(maps.missing), 'map')} missing; the same deltas depth goes on.")
    measured = maps.summary["settings"].get("sensor_depth")
    scored = any(frame.score is not None for frame in frames)
    if scored and isinstance(measured, dict) and measured.get("from") == "sensor":
        notes.append("The maps were made with the sensor depth that they are scored against.")
    if maps.unit != "m":
        notes.append("The capture has no metres: depth is in its own unit.")
    return notes


def _scale(scale: Scale) -> dict[str, Any]:
    return {
        "colours": _base64(lookup_table(scale)),
        "low": scale.low,
        "high": scale.high,
        "log": scale.log,
        "unit": scale.unit,
        "ticks": ticks_of(scale),
    }


def _frame(maps: Maps, frame: ShownFrame) -> dict[str, Any]:
    record = maps.record(frame.id)
    known = _numbers(record)
    facts = {}
    if frame.score is not None and frame.score.coverage > 0:
        facts["Abs Rel"] = f"{frame.score.abs_rel:.3f}"
    if "confidence" in known:
        facts["Confidence"] = f"{known['confidence']:.2f}"
    if "keypoints" in known:
        facts["Points"] = f"{known['valid_points']:g} of {known['keypoints']:g}"
    sources = record.get("sources")
    if isinstance(sources, list):
        facts["Sources"] = ", ".join(map(str, sources))
    if record.get("status") not in (None, "ok", "kept"):
        facts["Status"] = str(record["status"])
    pictures = {kind: _base64(file) for kind, file in frame.jpegs.items()}
    return {"id": frame.id, "facts": facts, "pictures": pictures}


def _scene(maps: Maps, frames: Sequence[ShownFrame], layers: Sequence[Layer]) -> dict[str, Any]:
    """Layers and cameras around the middle of the cameras, so that float32 is exact enough."""
    cameras = [camera_of(maps.capture.frame(id)) for id in maps.ids]
    centre = np.median([camera.world_from_cam[:3, 3] for camera in cameras], axis=0)
    shown = {frame.id: place for place, frame in enumerate(frames)}
    return {
        "up": _rounded(up_of(maps.capture)),
        "layers": [_layer(layer, centre) for layer in layers],
        "cameras": [_camera(camera, centre, shown.get(camera.id)) for camera in cameras],
    }


def _layer(layer: Layer, centre: NDArray[np.float64]) -> dict[str, Any]:
    xyz = layer.surface.xyz - centre
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    span = np.maximum(high - low, 1e-9)
    # What most of it fills: single points far away would make the rest a dot.
    middle = np.percentile(xyz, (3, 97), axis=0)
    faces = layer.surface.faces
    return {
        "name": layer.name,
        "count": len(xyz) if faces is None else len(faces),
        "low": _rounded(low),
        "span": _rounded(span),
        "box": [_rounded(middle[0]), _rounded(middle[1])],
        "xyz": _base64(np.rint(STEPS * (xyz - low) / span).astype("<u2")),
        "rgb": _base64(layer.surface.rgb),
        "faces": None if faces is None else _base64(faces.astype("<u4")),
    }


def _camera(camera: Camera, centre: NDArray[np.float64], frame: int | None) -> dict[str, Any]:
    pose = camera.world_from_cam[:3].copy()
    pose[:, 3] -= centre
    return {"pose": _rounded(pose.ravel()), "slopes": _rounded(camera.slopes), "frame": frame}


def _short(number: float) -> str:
    """Two digits of a number, without an exponent.

    Example:
        >>> _short(0.7134), _short(2.881), _short(124.7), _short(1.23e6), _short(4.2e-6)
        ('0.71', '2.9', '120', '1200000', '0.0000042')
    """
    return f"{Decimal(f'{number:.2g}'):f}"


def _rounded(numbers: Sequence[float] | NDArray[np.float64]) -> list[float]:
    return [float(f"{number:.7g}") for number in numbers]
