"""Other ways to depth than ours, behind the same commands, to measure beside it."""
