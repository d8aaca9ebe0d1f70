"""A capture to a point cloud: which decoder it needs, its depth range, its noise."""
