"""Simulate, plan and use the exposures of a study's views."""
