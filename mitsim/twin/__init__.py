"""Fit a sensor file to captures of one unit in one room: its digital twin."""
