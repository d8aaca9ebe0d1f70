"""Light and geometry: the only room that knows Mitsuba."""
