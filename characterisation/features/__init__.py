"""Surfaces, figures and edges fitted to points, and how sure the fits are."""
