"""Formulas of rays and waves, each in one place; no plugins, files or screens."""
