"""Figures by which sensors are accepted and sold: VDI/VDE 2634-2, and those of makers' data sheets."""
