"""Divide captures of a flat coupon into patches, measure them, and choose the orientations of the coupon."""
