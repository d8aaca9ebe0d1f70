"""Rays of cameras and what they meet in a scene: positions, normals, shapes, map values."""
