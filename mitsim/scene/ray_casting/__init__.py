"""Rays of cameras and the surfaces that they meet: positions, normals, shapes and values of maps."""
