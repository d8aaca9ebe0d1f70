"""Calibrate and control a stage that turns a coupon in front of a sensor: its angles and its axes."""
