"""Pixels, poses, posed views, and the way between points and pixels."""
