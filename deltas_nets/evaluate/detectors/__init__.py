"""Detectors and descriptors, scored by depth and poses: table 1 of the paper."""
