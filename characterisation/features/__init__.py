"""Fit surfaces, figures and edges to points, with the covariance of each fit."""
