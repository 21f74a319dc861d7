"""Pictures of a room: cast the rays, shade what they hit, and add what polished faces mirror."""

import math

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from deltas_nets.rooms.cast import Hits, cast_rays
from deltas_nets.rooms.furniture import BOX
from deltas_nets.rooms.scene import Room
from deltas_nets.rooms.shade import Shaded, shade
from deltas_nets.rooms.textures import Atlas

MAX_MIRRORS = 6
"""Faces of a view that mirror, the largest ones."""
SMALLEST_MIRROR = 0.004
"""Share of the image below which a face does not mirror."""
LONGEST_BLUR = 8.0  # pixels


@torch.no_grad()
def render_view(
    room: Room,
    atlas: Atlas,
    K: Tensor,
    cam_from_world: Tensor,
    *,
    image_size: tuple[int, int],
) -> tuple[Tensor, Tensor]:
    """What one camera sees.

    Args:
        room: as drawn by ``draw_room``.
        atlas: the textures that the room's surfaces name.
        K: ``(3, 3)``, without skew.
        cam_from_world: ``(4, 4)``, a camera inside the room and outside its solids.
        image_size: height, width.

    Returns:
        Radiance ``(3, H, W)``, not negative, before exposure; and depth ``(H, W)``,
        metres along z at the pixel centres, exact: of the surface itself where it mirrors.
    """
    hits = cast_rays(room.solids, K, cam_from_world, image_size=image_size)
    shaded = shade(room, atlas, hits, K, cam_from_world)
    radiance = shaded.radiance.view(3, *image_size).clone()
    _add_reflections(radiance, room, atlas, hits, shaded, K, cam_from_world)
    return _blur(radiance, room.blur), hits.depth


def _add_reflections(
    radiance: Tensor,
    room: Room,
    atlas: Atlas,
    hits: Hits,
    shaded: Shaded,
    K: Tensor,
    cam_from_world: Tensor,
) -> None:
    """Add to ``(3, H, W)`` what plane polished faces mirror, one bounce deep."""
    face = shaded.face.view(hits.depth.shape)
    share = shaded.mirrored.view(hits.depth.shape)
    for mirror in _mirrors(room, shaded.face):
        mask = face == mirror
        rows, columns = mask.any(1).nonzero(), mask.any(0).nonzero()
        window = (
            slice(int(rows[0]), int(rows[-1]) + 1),
            slice(int(columns[0]), int(columns[-1]) + 1),
        )
        shifted = K.clone()
        shifted[0, 2] -= window[1].start
        shifted[1, 2] -= window[0].start
        camera = cam_from_world @ _mirror_image(room, mirror)
        depth = hits.depth[window]
        seen = cast_rays(
            room.solids,
            shifted,
            camera,
            image_size=(depth.shape[0], depth.shape[1]),
            beyond=depth + 1e-3,
        )
        light = shade(room, atlas, seen, shifted, camera).radiance.view(3, *depth.shape)
        sigma = min(float(room.surfaces.roughness[mirror // 6] * K[0, 0]) / 2, LONGEST_BLUR)
        if sigma > 0.3:
            light = _blur(light, sigma)
        radiance[:, *window] += light * share[window] * mask[window]


def _mirrors(room: Room, face: Tensor) -> list[int]:
    """The largest polished plane faces in view; ``face`` ``(P,)`` as in :class:`Shaded`."""
    surfaces = room.surfaces
    counts = face.bincount(minlength=surfaces.gloss.numel())
    polished = (surfaces.gloss.flatten() > 0) & (room.solids.shape == BOX).repeat_interleave(6)
    counts = torch.where(polished & (counts > SMALLEST_MIRROR * len(face)), counts, 0)
    largest = counts.sort(descending=True, stable=True).indices[:MAX_MIRRORS]
    return [int(n) for n in largest if counts[n] > 0]


def _mirror_image(room: Room, face: int) -> Tensor:
    """The reflection ``(4, 4)`` of the world at the plane of a face."""
    solid, axis, sign = face // 6, face % 6 // 2, face % 2 * 2 - 1
    normal = room.solids.local_from_world[solid, axis]
    offset = normal @ room.solids.centre[solid] + sign * room.solids.half_size[solid, axis]
    reflection = torch.eye(4)
    reflection[:3, :3] -= 2 * torch.outer(normal, normal)
    reflection[:3, 3] = 2 * offset * normal
    return reflection


def _blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian of ``sigma`` pixels over ``(3, H, W)``."""
    # A reflection may be cut from a window smaller than the kernel.
    radius = min(max(1, math.ceil(2 * sigma)), min(image.shape[-2:]))
    size = (2 * radius + 1, 2 * radius + 1)
    blurred: Tensor = gaussian_blur2d(image[None], size, (sigma, sigma), "replicate")[0]
    return blurred
