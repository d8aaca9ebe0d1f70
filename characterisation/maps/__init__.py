"""Performance maps: many captures pooled over distance, normal and sample; the maps that come with mitsim."""
