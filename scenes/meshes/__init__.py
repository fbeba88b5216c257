"""Meshes of the built-in scenes, written by ``tools/make_meshes.py``, and the chart that several include."""
