"""The network: one file a part, `deltas.py` first."""
