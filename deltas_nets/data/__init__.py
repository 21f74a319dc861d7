"""Captures, view sets, samples and procedural rooms."""
