"""Formulas of ray and wave optics, each defined once, independent of plugins, files and displays."""
