"""The commands, one function each; :mod:`mitsim.cli` lists them."""
