"""Compare predictions with measurements: view scores, statements, maps and captures."""
