"""What a machined or painted surface does with light, without a renderer: numpy and scipy only.

Signal chain: what is known of a face (Ra and process, a trace, a height map, gloss, alpha) -> heights and their
autocorrelation (``roughness``, ``measured``) -> wave optics at the sensor's wavelength (``diffraction``) -> a
:class:`~mitsim.surface.scatter.Scatter` (``machined``, ``paint``), with the metals' constants (``metals``), the lobes
(``microfacet``), what they lose (``energy``) and the gloss they read (``gloss``).
"""
