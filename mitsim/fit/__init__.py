"""The simulator fitted to captures of a flat coupon: width of the lobe, power of the projector, residual."""
