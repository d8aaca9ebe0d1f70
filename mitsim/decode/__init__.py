"""From images to points: OpenCV's room."""
