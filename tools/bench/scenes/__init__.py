"""Scenes of single cases."""
