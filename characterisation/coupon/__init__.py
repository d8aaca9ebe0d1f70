"""Captures of a flat coupon: sub-point-clouds, their metrics, and the orientations at which it is shown."""
