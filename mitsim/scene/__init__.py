"""Scenes, materials, rays and light transport: the only room that imports Mitsuba."""
