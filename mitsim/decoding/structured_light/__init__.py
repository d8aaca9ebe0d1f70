"""Decode fringes and Gray codes to projector coordinates, and these to points."""
