"""Metric depth from posed images: the DELTAS network, its training, weights and command."""
