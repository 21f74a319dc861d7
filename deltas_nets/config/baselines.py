"""The table of other ways to depth than ours, by the names that `--weights` takes."""

BASELINES = {
    "plane-sweep": "plane_sweep:PlaneSweep",
    "colmap-sparse": "colmap:SparseInterpolated",
    "colmap-densified": "colmap:SparseDensified",
    "true-points": "given_points:TruePoints",
    "no-points": "given_points:NoPoints",
}
"""Name to "module:what" in `deltas_nets.baselines`; called with the device each is a `Predictor`.

They are named, not imported: they read what `predict` defines.
"""
