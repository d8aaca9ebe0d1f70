"""Describe a sensor: cameras, projector, imager, pattern, exposure and their frames."""
