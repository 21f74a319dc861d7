"""Stages of `deltas-small`."""
