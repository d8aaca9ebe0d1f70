"""Fit the priors of finishes to measured surfaces, and compare the model of a BSDF with a goniometer."""
