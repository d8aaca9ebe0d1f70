"""Reconstruct a point cloud from a capture: choose the decoder, its depth range and its noise."""
