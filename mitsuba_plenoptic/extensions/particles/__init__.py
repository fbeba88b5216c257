"""Extension `particles`: plenoptic particle image velocimetry, from particles and flows to velocity fields.

Images by rays, and tracking, need the extension `inverse`.
"""

from ...extension import Extension

EXTENSION = Extension(
    modules={"particles": "particles"},
    commands={"particles": "particles_command"},
    generators={"particles": "particle_pairs:ParticlePairs"},
)
