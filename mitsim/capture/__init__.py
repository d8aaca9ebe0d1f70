"""The capture: images with their cameras and settings, and the folder that keeps them."""
