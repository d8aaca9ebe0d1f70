"""State uncertainties from the errors of virtual measurements: statistics that require no renderer."""
