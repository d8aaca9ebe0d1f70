"""Entry point of ``python -m mitsim``."""

from mitsim.cli import main

main()
