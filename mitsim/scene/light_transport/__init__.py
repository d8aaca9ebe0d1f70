"""Light paths from the projector and the emitters, by way of a scene, to a camera."""
