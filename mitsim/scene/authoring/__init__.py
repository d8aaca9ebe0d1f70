"""Convert CAD files to scenes, and check scenes for pitfalls."""
