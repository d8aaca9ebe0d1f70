"""Captures simulated: a scene, a sensor and a pose to images, and to the truth beside them."""
