"""Plane sweep and semi-global matching: depth without learning."""
