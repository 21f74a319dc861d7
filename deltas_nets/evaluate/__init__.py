"""Depth metrics and reports."""
