"""Light paths from the projector and the emitters, over the scene, to a camera."""
