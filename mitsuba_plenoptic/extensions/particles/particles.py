"""Plenoptic particle image velocimetry: particles in flows, their captures, and velocities from these.

`particle_sequence` carries particles through a volume, and `ParticleImages` captures them by waves or by rays.
`reconstruct_volume` finds the light of voxels again, `correlate_volumes` the displacements between two volumes, and
`locate_particles`, `refine_particles` and `match_particles` those of single particles. Values out of range, empty or
dark volumes, and such as are not before the camera, raise an `InputError`.
"""

from .correlation import correlate_volumes
from .flows import Flow, HillVortex, ImportedFlow, LambOseen, Shear, TaylorGreen, Uniform
from .particle_images import ParticleImages
from .projection import RayProjector, VoxelProjector
from .scattering import cross_sections
from .seeding import LightSheet, ParticleVolume, Seeding, Window
from .sequence import particle_sequence
from .tomography import reconstruct_volume
from .tracking import locate_particles, match_particles, refine_particles
from .voxels import VoxelGrid, drawn_particles, elongation, ghost_fraction, quality

__all__ = [
    "Flow",
    "HillVortex",
    "ImportedFlow",
    "LambOseen",
    "LightSheet",
    "ParticleImages",
    "ParticleVolume",
    "RayProjector",
    "Seeding",
    "Shear",
    "TaylorGreen",
    "Uniform",
    "VoxelGrid",
    "VoxelProjector",
    "Window",
    "correlate_volumes",
    "cross_sections",
    "drawn_particles",
    "elongation",
    "ghost_fraction",
    "locate_particles",
    "match_particles",
    "particle_sequence",
    "quality",
    "reconstruct_volume",
    "refine_particles",
]
