"""The matcher that decides with all views at once."""
