"""Arrangements of microlenses: which lens a point belongs to, where its centre is, what its aperture lets through."""

from .base import APERTURES, KINDS, LENS_TYPES, Lattice, turn

__all__ = ["APERTURES", "KINDS", "LENS_TYPES", "Lattice", "turn"]
