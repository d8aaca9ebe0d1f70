"""Simulation: from a scene, a sensor and a pose to a capture and its ground truth."""
