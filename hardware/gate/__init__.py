"""Schematic of the gate and the ring: netlist from KiCad's text file, and the table of single failures."""
