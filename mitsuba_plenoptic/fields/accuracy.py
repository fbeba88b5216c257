"""Numbers that settle how exactly fields behind microlenses are described."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FieldAccuracy:
    """Counts, steps and limits; each costs time or memory where it is made finer."""

    # Directions behind an array
    hard_edges: float = 1.4  # directions retained for apertures with a dark surround, over those without gaps
    joined: float = 1 / 2  # orders retained where phases of neighbouring lenses join, over those of separate apertures
    slope_points: int = 65  # points across a lens at which the slopes of its shape are sampled
    steepest: float = 0.7  # largest direction cosine of an aperture's diffraction: the limit of scalar thin elements

    # Diffraction orders
    flat: float = 1e4  # focal length, in millimetres, of a lens without noticeable phase
    order_samples: tuple[int, int] = (64, 20)  # samples per period of the highest order, of one and of two coordinates
    edge_samples: int = 2048  # samples across a pitch; they limit the accuracy of the edges
    wave_samples: int = 8  # least samples per period of the highest retained order, which excludes aliasing

    # Kinds of lenses
    kind_step: float = 0.4  # phase in radians, at a lens's edge, between adjacent kinds; a lens differs by half of it
    kind_wavelength: float = 400.0  # wavelength in nanometres of this phase
    moment_samples: int = 256  # samples across a lens for the moments of its aperture
    most_kinds: int = 32  # largest number of kinds, each of which has images of its own


ACCURACY = FieldAccuracy()
"""The numbers in use."""
