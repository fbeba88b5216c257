"""What is poor about a camera's design."""

from __future__ import annotations

import math

from ..camera import PlenopticCamera
from ..design import lenses_across
from .design_sheet import four_digits


def design_warnings(camera: PlenopticCamera, wavelength: float | None = None) -> list[str]:
    """Say in one sentence each what is poor about a design.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float, optional
        Wavelength in nanometres; without it diffraction is not judged.
    """
    found = []
    diameter, pitch = camera.micro_image_diameter, camera.micro_image_pitch
    # The stop for which the micro-images just touch.
    touching = camera.aperture_diameter * pitch / diameter
    if diameter > pitch:
        found.append(
            f"micro-images overlap: their diameter of {four_digits(diameter)} mm exceeds their pitch of "
            f"{four_digits(pitch)} mm; stop the main lens down to a diameter of {four_digits(touching)} mm"
        )
    elif diameter < 0.5 * pitch:
        found.append(
            f"pixels are wasted: micro-images fill {diameter / pitch:.0%} of their pitch; open the main "
            f"lens to a diameter of {four_digits(touching)} mm, or shorten mla_focal_length"
        )
    elif camera.kind != "unfocused" and camera.crosstalk_lenses > 1:
        found.append(
            "micro-images overlap at their rims, which a lens that is in focus on the object blurs: light of "
            "neighbouring lenses mixes there; stop the main lens down, or narrow the lenses (mla_fill)"
        )
    image = max(camera.mla_distance - _focus_on_image(camera, lens) for lens in range(len(camera.mla_kinds)))
    if image < camera.focal_length:
        found.append(
            f"no object plane is in focus: the microlenses see a plane {four_digits(image)} mm behind the main lens, "
            f"within its focal length of {four_digits(camera.focal_length)} mm; lengthen mla_distance"
        )
    found += _coverage_warnings(camera)
    directions = camera.direction_count(wavelength)
    if directions < 2:
        found.append(f"no refocusing: across its diameter a micro-image tells only {directions:.2g} directions apart")
    if wavelength is not None:
        spot = camera.spot_size(wavelength)
        if camera.pixel_size > 0.5 * spot:
            pixel = four_digits(1e3 * camera.pixel_size)
            found.append(
                f"the detector undersamples the diffraction spot: a pixel of {pixel} um exceeds half"
                f" the spot's half width of {four_digits(1e3 * spot)} um"
            )
        fresnel = camera.mla_fresnel_number(wavelength)
        if fresnel < 1:
            found.append(f"the microlenses hardly focus: their Fresnel number is {fresnel:.2g}")
    return found


def _focus_on_image(camera: PlenopticCamera, lens: int) -> float:
    """Distance before the MLA of what a kind of lens is to see: 0 if unfocused, as the MLA itself is in focus then."""
    return 0.0 if camera.mla_kinds[lens] == "unfocused" else camera.mla_object_distances[lens]


def _coverage_warnings(camera: PlenopticCamera) -> list[str]:
    """Say where the lenses of a focused camera leave gaps between their pictures."""
    if camera.kind == "unfocused":
        return []
    cones = {g: lenses_across(camera, g) for g in camera.best_distances if camera.focal_length < g < math.inf}
    return [
        f"gaps at {four_digits(distance)} mm, where the microlenses are sharpest: the light of a point spans only "
        f"{across:.2g} of them; open the main lens, or move the detector so that they see farther"
        for distance, across in cones.items()
        if across < 1
    ]
