"""Meshes and textures of the built-in scenes, defined by their geometry, and the files that hold them."""
