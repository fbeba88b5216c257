"""A stand-in for Optiland where it is not installed: the glasses that `tools/record_optiland.py` recorded."""
