"""Warnings about a capture: of its images, of its rig, of its code."""
