"""Readers of captures, one file a format.

A reader is a file here that defines what `deltas_nets.captures.opening.Reader` lists, and a row in
`READERS` there. It makes a `Frame` of each image (`deltas_nets.captures.frame`) and ends with
`Capture(path, Frames.of(frames, path), lost)`. Ids name the files of results: leave suffixes out.
"""
