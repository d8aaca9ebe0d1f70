"""Compute figures for the acceptance and the data sheets of sensors: VDI/VDE 2634-2, and those of makers."""
