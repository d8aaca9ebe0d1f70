"""Virtual measurements: a measurement rendered, decoded and evaluated under everything that is not known of it."""
