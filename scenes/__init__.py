"""The built-in scenes: Mitsuba XML files with their meshes and textures."""
