"""Judge 3D sensors from their point clouds alone.

Point clouds in; performance maps, features, measurements and view scores out. Nothing in here knows whether a cloud
was rendered or measured, which is what makes the judgement the same for both.
"""
