"""Cameras whose images are not straight: models, projection, rays, images undistorted."""
