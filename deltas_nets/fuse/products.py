"""What a fusion writes: a table of files, and the functions that write them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

from deltas_nets.captures.frame import FloatArray
from deltas_nets.fuse.files import check_mesh_extra, write_cloud_ply, write_glb, write_mesh_ply

__all__ = ["FUSED", "FusedName", "FusedProduct"]

FusedName = Literal["cloud", "mesh", "glb"]


class FusedProduct(NamedTuple):
    """A file of a fused capture.

    Attributes:
        file: its name.
        of: what it is made of: a cloud's points or a volume's surface.
        write: writes it, of a world with an up as `up_of` tells it.
        check: raises `UserError` where it cannot be written here.
    """

    file: str
    of: Literal["points", "surface"]
    write: Callable[[Path, Any, FloatArray], None]
    check: Callable[[Path], None] = lambda _: None


FUSED: dict[FusedName, FusedProduct] = {
    "cloud": FusedProduct("cloud.ply", "points", write_cloud_ply),
    "mesh": FusedProduct("mesh.ply", "surface", write_mesh_ply),
    "glb": FusedProduct("mesh.glb", "surface", write_glb, check_mesh_extra),
}
