"""Changes of a study that would make measurements fit their tolerances, confirmed by virtual measurements."""
