"""Live devices and stages: the only room that knows vendors' software and serial lines."""
