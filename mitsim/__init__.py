"""Simulate 3D vision sensors on Mitsuba 3, and judge them by the clouds that they make."""

__version__ = "0.1.0"
