"""Plenoptic particle image velocimetry: particles in flows, their captures, and velocities from these."""

from .flows import FLOWS, Flow, HillVortex, ImportedFlow, LambOseen, Shear, TaylorGreen, Uniform
from .images import ParticleImages
from .labelled_files import read_netcdf, write_netcdf
from .mie import cross_sections
from .seeding import LightSheet, ParticleVolume, Seeding
from .sequence import particle_sequence

__all__ = [
    "FLOWS",
    "Flow",
    "HillVortex",
    "ImportedFlow",
    "LambOseen",
    "LightSheet",
    "ParticleImages",
    "ParticleVolume",
    "Seeding",
    "Shear",
    "TaylorGreen",
    "Uniform",
    "cross_sections",
    "particle_sequence",
    "read_netcdf",
    "write_netcdf",
]
