"""The commands of `deltas`, one file each; `cli.py` lists them."""
