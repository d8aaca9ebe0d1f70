"""Draw clouds, maps and statements with matplotlib: the style of all figures, and the pictures of the ``plot`` methods.

Functions here draw plain arrays into axes. The types that are drawn import this package when ``plot`` is called, so
that matplotlib is loaded only then.
"""
