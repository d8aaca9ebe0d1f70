"""Pool many captures to performance maps over distance, normal and sample; find the maps that come with mitsim."""
