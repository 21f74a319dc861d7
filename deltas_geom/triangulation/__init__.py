"""Points from the pixels or rays of several views, with status, gradients and uncertainty."""
