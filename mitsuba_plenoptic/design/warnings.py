"""Warnings about the design of a camera, as sentences."""

from __future__ import annotations

import math

from ..camera import PlenopticCamera
from ..collimator import Collimator
from .aberration import parabolic_aberration
from .focus import best_distances, best_images, focus_type, lenses_across
from .micro_images import crosstalk_lenses, direction_count, micro_image_distance, mla_fresnel_number, spot_radius
from .microscope import microscope_warnings

_SMALLEST_PIXEL = 2e-4
"""Of detectors, in millimetres."""

_DUAL = 0.01
"""Largest relative deviation from two pixels across the lenses of dual and quad pixels."""


_RAYLEIGH = 0.25
"""Aberration in waves that is hardly seen, by Rayleigh's criterion."""


def design_warnings(camera: PlenopticCamera, wavelength: float | None = None) -> list[str]:
    """Return warnings about a design, one sentence each."""
    if isinstance(camera.main_lens, Collimator):
        return []
    if not camera.lens_data.converges:
        return microscope_warnings(camera, wavelength)
    found = []
    diameter, pitch = camera.micro_image_diameter, micro_image_distance(camera)
    # The stop for which the micro-images just touch.
    touching = camera.aperture_diameter * pitch / diameter
    if diameter > pitch:
        found.append(
            f"micro-images overlap: their diameter of {diameter:.4g} mm exceeds their pitch of "
            f"{pitch:.4g} mm; stop the main lens down to a diameter of {touching:.4g} mm"
        )
    elif diameter < 0.5 * pitch:
        found.append(
            f"pixels are wasted: micro-images fill {diameter / pitch:.0%} of their pitch; open the main "
            f"lens to a diameter of {touching:.4g} mm, or shorten mla_focal_length"
        )
    elif focus_type(camera) != "unfocused" and crosstalk_lenses(camera) > 1:
        found.append(
            "micro-images overlap at their rims, which a lens that is in focus on the object blurs: light of "
            "neighbouring lenses mixes there; stop the main lens down, or narrow the lenses (mla_fill)"
        )
    image = max(best_images(camera))
    if image < camera.focal_length:
        found.append(
            f"no object plane is in focus: the microlenses see a plane {image:.4g} mm behind the main lens, "
            f"within its focal length of {camera.focal_length:.4g} mm; lengthen mla_distance"
        )
    found += _coverage_warnings(camera)
    if camera.pixel_size < _SMALLEST_PIXEL:
        found.append(
            f"a pixel is {camera.pixel_size:.3g} mm wide, less than a wavelength of light: lengths are taken as "
            "millimetres; if these are metres, multiply them by 1000"
        )
    directions = direction_count(camera, wavelength)
    # Two pixels a lens are for the sides of the pupil, not for directions.
    if directions < 2 and abs(camera.pixels_per_lens / 2 - 1) > _DUAL:
        found.append(f"no refocusing: across its diameter a micro-image resolves only {directions:.2g} directions")
    if wavelength is not None:
        spot = spot_radius(camera, wavelength)
        if camera.pixel_size > 0.5 * spot:
            found.append(
                f"the detector undersamples the diffraction spot: a pixel of {1e3 * camera.pixel_size:.4g} um "
                f"exceeds half the spot's radius of {1e3 * spot:.4g} um"
            )
        fresnel = mla_fresnel_number(camera, wavelength)
        if fresnel < 1:
            found.append(f"the microlenses hardly focus: their Fresnel number is {fresnel:.2g}")
        aberration = parabolic_aberration(camera, wavelength) if camera.lens_model == "parabolic" else 0
        if aberration > _RAYLEIGH:
            found.append(
                f"lens_model parabolic: the main lens aberrates light by {aberration:.2g} waves over the field; ideal "
                "is without aberrations, and a smaller aperture_radius or detector_width lessens them"
            )
    return found


def _coverage_warnings(camera: PlenopticCamera) -> list[str]:
    """Return warnings if the lenses of a focused camera leave gaps at the distances where they are sharpest."""
    if focus_type(camera) == "unfocused":
        return []
    cones = {g: lenses_across(camera, g) for g in best_distances(camera) if camera.focal_length < g < math.inf}
    return [
        f"gaps at {distance:.4g} mm, where the microlenses are sharpest: the light of a point spans only "
        f"{across:.2g} of them; open the main lens, or move the detector so that they see farther"
        for distance, across in cones.items()
        if across < 1
    ]
