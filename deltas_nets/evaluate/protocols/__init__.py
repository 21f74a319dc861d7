"""Which frames are scored, from which sources: rules that others have written down."""
