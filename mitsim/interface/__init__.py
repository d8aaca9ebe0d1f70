"""The functions of ``import mitsim as ms``; commands are thin wrappers around them."""
