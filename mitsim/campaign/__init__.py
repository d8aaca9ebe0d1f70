"""Campaigns: coupons shown to a sensor at many orientations, and the performance map that comes of it."""
