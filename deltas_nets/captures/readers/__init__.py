"""Readers of captures, one file a format.

A reader is a file here that defines what `deltas_nets.captures.opening.Reader` lists, and a row in
`READERS` there.
"""
