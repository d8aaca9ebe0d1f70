"""Model the scattering of light by machined and painted surfaces, without a renderer: numpy and scipy only.

Signal chain: known properties of a face (Ra and process, a trace, a height map, gloss, alpha) -> heights and their
autocorrelation (``roughness``, ``measured``) -> wave optics at the sensor's wavelength (``diffraction``) -> a
:class:`~mitsim.scene.surface.scatter.Scatter` (``machined``, ``paint``), with the metals' constants (``metals``), the
lobes (``microfacet``), their energy loss (``energy``) and their gloss (``gloss``).
"""
