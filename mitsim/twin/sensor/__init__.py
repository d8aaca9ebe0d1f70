"""A sensor file fitted to captures of one unit in one room."""
