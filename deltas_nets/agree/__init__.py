"""Depth maps of one capture made to agree: each says what several say of a place."""
