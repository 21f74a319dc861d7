"""A network that compares every pixel at every depth: what `deltas-small` is measured against."""
