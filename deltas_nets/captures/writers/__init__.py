"""Writers of captures, one file a format.

A writer is a function that fills an empty folder with a capture and returns what it had to leave
out, in words; and a row in `WRITERS` of `deltas_nets.captures.saving`. It raises `UserError` where
the format cannot hold what a depth map needs: a pose, intrinsics, a lens.
"""
