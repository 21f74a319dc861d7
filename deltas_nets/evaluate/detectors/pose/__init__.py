"""Poses from matches: minimal solvers, consensus, refinement."""
