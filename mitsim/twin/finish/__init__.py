"""Fit the simulation to captures of a flat coupon: width of its lobe, power of the projector, residuals."""
