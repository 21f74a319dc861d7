"""What training makes small, term by term."""
