"""Captures: posed images as people have them, and which of them go together."""
