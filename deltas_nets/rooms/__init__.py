"""Procedural rooms: posed images with exact depth, as many as one likes."""

from deltas_nets.rooms.close_up import draw_close_up
from deltas_nets.rooms.materials import Surfaces
from deltas_nets.rooms.render import render_view
from deltas_nets.rooms.rooms import Rooms, render_close_up, render_room
from deltas_nets.rooms.scene import Light, Room, Solids, draw_room
from deltas_nets.rooms.textures import Atlas, texture_atlas

__all__ = [
    "Atlas",
    "Light",
    "Room",
    "Rooms",
    "Solids",
    "Surfaces",
    "draw_close_up",
    "draw_room",
    "render_close_up",
    "render_room",
    "render_view",
    "texture_atlas",
]
