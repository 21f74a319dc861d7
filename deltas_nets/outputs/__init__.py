"""Files of results, whole whenever they exist."""
