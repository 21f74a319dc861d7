"""Readers of posed captures, one file a format."""
