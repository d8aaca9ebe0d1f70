"""Describe a capture, its images with cameras and settings, and read and write its folder."""
