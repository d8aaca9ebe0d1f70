"""Tests of mitsim and characterisation, in folders that mirror the packages."""
