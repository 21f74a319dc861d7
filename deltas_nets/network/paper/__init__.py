"""Stages of the paper's networks."""
