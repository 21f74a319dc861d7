"""From frames to depth maps, by any network."""
