"""Fringes and Gray codes to projector coordinates, and those to points."""
