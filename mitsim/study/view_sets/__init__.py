"""Sets of views that are measured together in virtual measurements, and the search for sets that keep their limits."""
