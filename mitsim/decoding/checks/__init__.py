"""Warn about a capture: its images, its rig, its code."""
