"""Which sample looks like the keypoint: correlation, expectation, matches of one or all views."""
