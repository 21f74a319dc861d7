"""A detector that learns interest points from another one."""
