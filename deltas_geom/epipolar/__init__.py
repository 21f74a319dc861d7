"""Where a pixel of one view can be in another: lines, segments, samples along them."""
