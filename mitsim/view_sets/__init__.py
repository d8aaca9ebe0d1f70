"""Views measured together in virtual measurements, and the sets of them that keep their limits."""
