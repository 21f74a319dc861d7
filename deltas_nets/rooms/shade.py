"""Light that the surfaces of a room send to a camera."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.rooms.cast import Hits, pixel_rays
from deltas_nets.rooms.furniture import BOX, CYLINDER
from deltas_nets.rooms.scene import Room
from deltas_nets.rooms.textures import (
    LEVEL_SIZES,
    TEXELS_PER_TEXTURE,
    TEXTURE_SIZE,
    Atlas,
)

LAMP_SIZE = 0.1  # rad, as seen from a surface
LAMP_RADIANCE = 20.0  # against the light that it gives


class Shaded(NamedTuple):
    """What each of the P pixels sees, before reflections."""

    radiance: Tensor
    """``(3, P)`` of the surface itself and of the lamp's highlight on it."""
    face: Tensor
    """``(P,)`` int64: 6 times the solid, plus the face as in ``Surfaces``."""
    mirrored: Tensor
    """``(P,)`` share of the light from the mirrored direction that reaches the camera."""


def shade(room: Room, atlas: Atlas, hits: Hits, K: Tensor, cam_from_world: Tensor) -> Shaded:
    """Light that each pixel's point sends to the camera by itself.

    Args:
        room: as drawn by ``draw_room``.
        atlas: the textures that the room's surfaces name.
        hits: from ``cast_rays``.
        K: ``(3, 3)``, without skew.
        cam_from_world: ``(4, 4)``, as for ``cast_rays``.
    """
    solids, surfaces, light = room.solids, room.surfaces, room.light
    turn = cam_from_world[:3, :3]
    camera = -turn.mT @ cam_from_world[:3, 3]
    ray_x, ray_y = pixel_rays(K, image_size=(hits.depth.shape[0], hits.depth.shape[1]))
    ray = torch.stack([*torch.meshgrid(ray_x, ray_y, indexing="xy"), torch.ones_like(hits.depth)])
    points = turn.mT @ (ray * hits.depth).flatten(1) + camera[:, None]  # (3, P)

    # Everything below happens in the axes of the solid that a pixel sees.
    up = solids.local_from_world[..., 1] * -1
    to_local = solids.local_from_world
    table = torch.cat(
        [
            to_local.flatten(1),
            -_apply(to_local, solids.centre),
            _apply(to_local, light.position - solids.centre),
            _apply(to_local, camera - solids.centre),
            solids.half_size,
            up,
            surfaces.shade,
        ],
        dim=1,
    )
    index = hits.solid.flatten()
    rotation, shift, lamp, eye, half_size, up, shade = (
        table.T.contiguous().index_select(1, index).split_with_sizes([9, 3, 3, 3, 3, 3, 7])
    )
    local = (rotation.view(3, 3, -1) * points).sum(dim=1) + shift
    axis, normal = _face(local / half_size, half_size, solids.shape[index], index == 0)
    u = torch.where(axis == 0, local[2], local[0])
    v = torch.where(axis == 1, local[2], local[1])

    to_lamp, to_eye = lamp - local, eye - local
    lamp_distance = _length(to_lamp)
    facing = ((to_lamp * normal).sum(dim=0) / lamp_distance).clamp_min(0)
    falloff = facing / (0.35 + 0.12 * lamp_distance.square())
    # The ceiling is lit by the floor: what looks down gets half of the ambient light.
    sky = 0.75 + 0.25 * (up * normal).sum(dim=0)
    wave = torch.sin(local * shade[:3] + shade[3:6]).sum(dim=0)
    shadow = 1 - shade[6] * (0.5 + 0.5 * torch.tanh(3 * wave))
    irradiance = light.ambient[:, None] * sky + light.lamp[:, None] * falloff

    eye_distance = _length(to_eye)
    cosine = ((to_eye * normal).sum(dim=0).abs() / eye_distance).clamp(0, 1)
    slant = cosine.clamp_min(0.05)
    # Metres of surface under a pixel; the geometric mean of its long and short side.
    footprint = eye_distance / K[0, 0] / slant.sqrt()
    face = 6 * index + 2 * axis + (local.gather(0, axis[None])[0] > 0)
    own = _albedo(room, atlas, face, u, v, footprint) * irradiance * shadow

    # Schlick's approximation of Fresnel: everything polished mirrors at grazing angles.
    gloss = surfaces.gloss.flatten()[face]
    mirrored = torch.where(gloss > 0, gloss + (1 - gloss) * (1 - cosine) ** 5, 0.0)
    halfway = to_eye / eye_distance + to_lamp / lamp_distance
    lobe = LAMP_SIZE**2 + surfaces.roughness[index].square()
    aligned = torch.exp(-4 * (1 - (halfway * normal).sum(dim=0) / _length(halfway)) / lobe) * (
        facing > 0
    )
    highlight = LAMP_RADIANCE * LAMP_SIZE**2 / lobe * aligned * mirrored
    return Shaded(own + light.lamp[:, None] * highlight, face, mirrored)


def _length(vectors: Tensor) -> Tensor:
    """Norms ``(P,)`` of ``(3, P)``; torch's own takes ten times longer along dim 0."""
    return vectors.square().sum(dim=0).clamp_min(1e-12).sqrt()


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors[..., None])[..., 0]


def _face(unit: Tensor, half_size: Tensor, shape: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
    """The axis ``(P,)`` whose face a point lies on, and the unit normal ``(3, P)`` there.

    Round solids have the faces of the box around them: the texture is projected along
    the axis on which the point is farthest out.

    Args:
        unit: ``(3, P)`` points on the surface of the unit cube, ball or cylinder.
        half_size: ``(3, P)`` metres, of the solid each point belongs to.
        shape: ``(P,)`` BOX, ELLIPSOID or CYLINDER.
        inside: ``(P,)`` True where the solid is seen from inside.
    """
    x, y, z = unit.abs()
    is_cylinder = shape == CYLINDER
    # On the caps |y| = 1 > radius, on the side |y| < 1 = radius: no threshold needed.
    rim = torch.where(is_cylinder, torch.hypot(x, z), torch.maximum(x, z))
    axis = torch.where(y > rim, 1, torch.where(x >= z, 0, 2))
    one_hot = axis == torch.arange(3)[:, None]
    flat = torch.where(one_hot, unit.sign(), 0.0)
    radial = unit / half_size  # the gradient of the quadric
    upright = torch.stack([radial[0], torch.zeros_like(y), radial[2]])
    curved = torch.where(is_cylinder, upright, radial)
    is_flat = (shape == BOX) | (is_cylinder & (axis == 1))
    normal = torch.where(is_flat, flat, curved / _length(curved))
    return axis, torch.where(inside, -normal, normal)


def _albedo(
    room: Room, atlas: Atlas, face: Tensor, u: Tensor, v: Tensor, footprint: Tensor
) -> Tensor:
    """Colour of the surface ``(3, P)`` under each pixel, filtered to its size."""
    surfaces = room.surfaces
    table = torch.cat(
        [
            surfaces.scale.flatten(0, 1),
            surfaces.offset.flatten(0, 1),
            surfaces.tint.flatten(0, 1),
            surfaces.contrast.flatten()[:, None],
        ],
        dim=1,
    )
    scale, offset, tint, contrast = (
        table.T.contiguous().index_select(1, face).split_with_sizes([2, 2, 3, 1])
    )
    place = scale * torch.stack([u, v]) + offset
    texels = footprint * scale.mean(dim=0) * TEXTURE_SIZE
    level = texels.log2().clamp(0, len(LEVEL_SIZES) - 1)
    first = surfaces.texture.flatten()[face] * TEXELS_PER_TEXTURE
    finer = level.long()
    coarser = (finer + 1).clamp_max(len(LEVEL_SIZES) - 1)
    blend = level - finer
    colour = _bilinear(atlas, first, finer, place, weight=1 - blend)
    colour = colour + _bilinear(atlas, first, coarser, place, weight=blend)
    return tint * (0.5 + contrast * (colour / 255 - 0.5)).clamp_min(0)


def _bilinear(
    atlas: Atlas, first: Tensor, level: Tensor, place: Tensor, *, weight: Tensor
) -> Tensor:
    """Weighted texture values ``(3, P)`` in 0 ... 255 at ``place``, ``(2, P)`` repetitions.

    Args:
        atlas: where the texels are.
        first: ``(P,)`` the first texel of each texture.
        level: ``(P,)`` which of ``LEVEL_SIZES``.
        place: ``(2, P)``.
        weight: ``(P,)`` multiplies the values.
    """
    sizes = torch.tensor(LEVEL_SIZES)
    starts = sizes.square().cumsum(0) - sizes.square()
    size = sizes[level]
    start = first + starts[level]
    # Texel i covers i ... i + 1 of `size`: its centre is at i + 0.5.
    continuous = place * size - 0.5
    corner = continuous.floor()
    (right, down) = continuous - corner
    # The sizes are powers of two, so `&` wraps around, negative numbers too.
    x0, y0 = corner.long() & (size - 1)
    x1, y1 = (x0 + 1) & (size - 1), (y0 + 1) & (size - 1)
    total = torch.zeros(len(level), 3)
    for x, weight_x in ((x0, 1 - right), (x1, right)):
        for y, weight_y in ((y0, 1 - down), (y1, down)):
            texels = atlas.texels.index_select(0, start + y * size + x)
            total.addcmul_(texels.float(), (weight * weight_x * weight_y)[:, None])
    return total.T
