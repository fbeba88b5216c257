"""What follows from a microscope's parameters, as groups of the design sheet."""

from __future__ import annotations

import math

from .. import design
from ..camera import PlenopticCamera
from ..objective import Objective

# Quantity, value, unit and note.
Line = tuple[str, str, str, str]


def microscope_groups(camera: PlenopticCamera, lens: Objective, wavelength: float | None) -> dict[str, list[Line]]:
    """Return the groups of the sheet that tell of the objective, and of what is seen through it."""
    groups = {"Objective": _objective(camera, lens)}
    groups["Array"] = _fourier(camera, lens) if lens.images_stop else _image(camera, lens)
    if wavelength is not None:
        groups[f"Diffraction at {wavelength:g} nm"] = _diffraction(camera, lens, wavelength)
    return groups


def _objective(camera: PlenopticCamera, lens: Objective) -> list[Line]:
    return [
        ("magnification", f"{lens.magnification:g}", "", f"{_four(lens.image_aperture)} NA in the native image"),
        ("numerical aperture", f"{lens.numerical_aperture:g}", "", f"up to {math.degrees(lens.half_angle):.3g} deg"),
        ("immersion", f"{lens.immersion:g}", "", "refractive index"),
        ("focal length", _four(lens.focal_length), "mm", f"tube lens of {_four(lens.tube_focal_length)} mm"),
        ("stop", _four(2 * lens.stop_radius), "mm", "diameter, in the back focal plane"),
        ("object seen", _four(1e3 * design.native_field(camera)), "um", "width"),
    ]


def _image(camera: PlenopticCamera, lens: Objective) -> list[Line]:
    micro, main = camera.detector_distance / camera.lattice.aperture_width, 1 / (2 * lens.image_aperture)
    pixel = camera.pixel_size
    return [
        ("kind of camera", "light-field microscope", "", "array in the native image plane"),
        ("lens pitch in the object", _four(1e3 * camera.mla_pitch / lens.magnification), "um", ""),
        ("f-number z/width", f"{micro:.3g}", "", ""),
        ("objective's M/2NA", f"{main:.3g}", "", "micro-images touch where the two match"),
        ("micro-image", _four(camera.micro_image_diameter / pixel), "pixels", f"of {_four(camera.mla_pitch / pixel)}"),
        ("mean of a white capture", f"{design.white_mean(camera):.3g}", "", "per unit radiance"),
    ]


def _fourier(camera: PlenopticCamera, lens: Objective) -> list[Line]:
    outer = 0.5 * (lens.blur_diameter(0) - camera.mla_pitch)
    rows = [
        (
            "kind of camera",
            "Fourier light-field microscope",
            "",
            f"lens of {_four(lens.last_focal_length)} mm before the array",
        ),
        ("image of the stop", _four(lens.blur_diameter(0)), "mm", ""),
        ("lenses across it", f"{design.lenses_across_stop(camera):.3g}", "", ""),
        ("numerical aperture of a lens", _four(design.lens_aperture(camera)), "", ""),
        ("pixel in the object", _four(1e3 * camera.bin_size(0)), "um", ""),
    ]
    if outer > 0:
        note = f"per um of depth, of a lens {_four(outer)} mm from the axis"
        rows.append(("parallax", _four(abs(design.parallax(camera, outer))), "um", note))
    return rows


def _diffraction(camera: PlenopticCamera, lens: Objective, wavelength: float) -> list[Line]:
    width, spot = camera.lattice.aperture_width, design.spot_radius(camera, wavelength)
    rows = [
        ("objective's limit", _four(design.objective_limit(camera, wavelength)), "lp/mm", "2 NA over the wavelength"),
        ("spot of a microlens", _four(1e3 * spot), "um", f"{_four(spot / camera.pixel_size)} pixels"),
    ]
    if lens.images_stop:
        aperture = design.lens_aperture(camera)
        depth = lens.immersion * wavelength * 1e-3 / aperture**2
        rows.append(("limit of a lens", _four(2e6 * aperture / wavelength), "lp/mm", ""))
        rows.append(("depth of field", _four(depth), "um", "of a lens, n times the wavelength over its NA squared"))
        shallow, sample = 1e-3 * depth, "pixel"
    else:
        shallow, sample = lens.immersion * width**2 / (2 * lens.magnification**2 * wavelength * 1e-6), "lens"
    for depth in (shallow, 2 * shallow, 4 * shallow):
        limit = design.resolution_limit(camera, 1.001 * depth, wavelength)
        told = f"at depths of {_four(1e3 * depth)} um; {limit.frequency / limit.lenses:.2g} times one sample a {sample}"
        rows.append(("resolution, deconvolved", _four(limit.frequency), "lp/mm", told))
    return rows


def _four(value: float) -> str:
    """Four digits."""
    return f"{value:.4g}"
