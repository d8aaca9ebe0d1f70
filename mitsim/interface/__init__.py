"""The functions that ``import mitsim as ms`` gives; commands are thin users of them."""
