"""Entry point of ``python -m mitsim``."""

from mitsim.cli.program import main

main()
