"""Scenes: loading, the radiance along rays, and captures of scenes with their cost."""
