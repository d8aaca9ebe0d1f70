"""Measure clouds without a study: features in windows, plates of dots, tasks, and differences of clouds."""
