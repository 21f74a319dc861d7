"""Depth maps of a capture become one cloud and one mesh.

    maps -> what their neighbours confirm -> thinned cloud
                                          -> volume of signed distances -> surface

`Cloud` and `Volume` take a `DepthView` at a time, in any order; `agreeing` is what the neighbours
of a view leave of it. `deltas_nets.fuse.fusing.fuse_capture` runs it all on files.
"""

from deltas_nets.fuse.agreement import Agreement, agreeing, agreement
from deltas_nets.fuse.cloud import Cloud, CloudPoints
from deltas_nets.fuse.config import FuseConfig
from deltas_nets.fuse.depth_view import DepthView
from deltas_nets.fuse.mesh import Mesh, without_small_parts
from deltas_nets.fuse.surface import surface
from deltas_nets.fuse.volume import Volume

__all__ = [
    "Agreement",
    "Cloud",
    "CloudPoints",
    "DepthView",
    "FuseConfig",
    "Mesh",
    "Volume",
    "agreeing",
    "agreement",
    "surface",
    "without_small_parts",
]
