"""Readers: what others' devices and programs saved, as captures. One file for each kind."""
