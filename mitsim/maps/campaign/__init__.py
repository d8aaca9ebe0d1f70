"""Campaigns: show coupons to a sensor in many orientations, and make its performance map from the captures."""
