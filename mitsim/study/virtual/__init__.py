"""Virtual measurements: a measurement that is rendered, decoded and evaluated with random values of all unknowns."""
