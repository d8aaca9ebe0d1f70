"""Light paths from projector and lamps by way of a scene to a camera."""
