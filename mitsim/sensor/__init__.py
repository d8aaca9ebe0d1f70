"""What a sensor is: cameras, projector, imager, pattern, exposure, and the frames they live in."""
