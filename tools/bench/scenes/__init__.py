"""Scenes that cases and tests share."""
