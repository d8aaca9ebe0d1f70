"""Exposures of a study: swept from one tracing, planned, and measured together."""
