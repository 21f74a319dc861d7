"""Why cameras and matches do not agree: one cause, its evidence and its cure."""
