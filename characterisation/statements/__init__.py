"""Statements of uncertainty from trials: the statistics of virtual measurements, which need no renderer."""
