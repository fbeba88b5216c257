"""Extension `particles`: plenoptic particle image velocimetry, from particles and flows to velocity fields.

Images by rays, and tracking, need the extension `inverse`.
"""

from ...extension import Extension

EXTENSION = Extension(
    modules={"particles": "particles"},
    commands={
        "particles": (
            "particles_command",
            "Capture particles in a flow at several times, with their exact displacements.",
        ),
    },
    generators={"particles": "particle_pairs:ParticlePairs"},
)
