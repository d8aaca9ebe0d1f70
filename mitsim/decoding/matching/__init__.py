"""Match two images, or an image and its reference, to disparity and points."""
