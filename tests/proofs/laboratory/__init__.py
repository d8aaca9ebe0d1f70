"""An independent laboratory that judges statements in worlds which mitsim did not render.

Signal chain: cases (:mod:`.cases`) -> a world, drawn from the unknowns of the study -> finish of a family
(:mod:`.finishes`), mask (:mod:`.masks`) -> light by stock Mitsuba (:mod:`.part`, :mod:`.optics`) -> images by an imager
of its own (:mod:`.imager`) -> cloud by one of several decoders (:mod:`.decoders`) -> errors of the measurements
(:mod:`.worlds`) -> share inside the stated intervals (:mod:`.page`).

No image comes from ``mitsim.scene.light_transport`` or ``mitsim.scene.ray_casting``.
"""
