"""A capture and its maps in three dimensions, served to a browser by viser."""
