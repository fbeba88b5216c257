"""What follows from a camera's parameters, as a sheet to read, and what is poor about the design."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..camera import PlenopticCamera


class Row(NamedTuple):
    """One quantity of the sheet."""

    group: str
    quantity: str
    value: str
    unit: str
    note: str


def design_sheet(camera: PlenopticCamera, wavelength: float | None = None) -> list[Row]:
    """List a camera's parameters and derived quantities.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float, optional
        Wavelength in nanometres; without it what follows from diffraction is left out.
    """
    rows = [*_main_lens(camera), *_microlenses(camera), *_detector(camera), *_micro_images(camera)]
    rows += _refocusing(camera, wavelength)
    if wavelength is not None:
        rows += _diffraction(camera, wavelength)
    return rows


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
            f"micro-images overlap: their diameter of {_text(diameter)} mm exceeds their pitch of "
            f"{_text(pitch)} mm; stop the main lens down to a diameter of {_text(touching)} mm"
        )
    elif diameter < 0.5 * pitch:
        found.append(
            f"pixels are wasted: micro-images fill {diameter / pitch:.0%} of their pitch; open the main "
            f"lens to a diameter of {_text(touching)} mm, or shorten mla_focal_length"
        )
    if camera.focus_distance < 0:
        found.append(
            f"no object plane is in focus: the microlenses stand within the focal length, mla_distance "
            f"{_text(camera.mla_distance)} < focal_length {_text(camera.focal_length)}"
        )
    directions = camera.direction_count(wavelength)
    if directions < 2:
        found.append(f"no refocusing: across its diameter a micro-image tells only {directions:.2g} directions apart")
    if wavelength is not None:
        spot = camera.spot_size(wavelength)
        if camera.pixel_size > 0.5 * spot:
            pixel = _text(1e3 * camera.pixel_size)
            found.append(
                f"the detector undersamples the diffraction spot: a pixel of {pixel} um exceeds half"
                f" the spot's half width of {_text(1e3 * spot)} um"
            )
        fresnel = camera.mla_fresnel_number(wavelength)
        if fresnel < 1:
            found.append(f"the microlenses hardly focus: their Fresnel number is {fresnel:.2g}")
    return found


def _main_lens(camera: PlenopticCamera) -> list[Row]:
    group = "Main lens"
    rows = [
        Row(group, "focal length", _text(camera.focal_length), "mm", ""),
        Row(group, "diameter", _text(camera.aperture_diameter), "mm", f"f/{camera.f_number:.3g}"),
        Row(group, "distance to microlenses", _text(camera.mla_distance), "mm", ""),
        Row(group, "focused distance", *_distance(camera.focus_distance), ""),
        Row(group, "field of view", f"{camera.field_of_view:.3g}", "deg", "horizontal, full angle"),
    ]
    if 0 < camera.focus_distance < math.inf:
        width = camera.field_width(camera.focus_distance)
        rows.append(Row(group, "field width", _text(width), "mm", "in the focused plane"))
    rows.append(Row(group, "lens model", camera.lens_model, "", ""))
    return rows


def _microlenses(camera: PlenopticCamera) -> list[Row]:
    group = "Microlenses"
    main, micro = camera.image_f_number, camera.mla_f_number
    # Neighbouring micro-images touch where the two match, up to the factor (b + z)/b of their pitch.
    if math.isclose(micro, main, rel_tol=0.05):
        match = "matches: micro-images touch"
    else:
        match = "faster than a microlens: overlap" if main < micro else "slower than a microlens: gaps"
    columns, rows = camera.lens_count
    bins = "also the bins of a reconstruction"
    if camera.lens_count != camera.bin_count:
        bins = f"in rows; a reconstruction has {camera.bin_count[0]} x {camera.bin_count[1]} bins"
    lattice = [f"{camera.mla_lattice} lattice"]
    if camera.mla_rotation:
        lattice.append(f"turned by {_text(camera.mla_rotation)} deg")
    if camera.mla_offset != (0, 0):
        lattice.append(f"moved by ({', '.join(map(_text, camera.mla_offset))}) mm")
    area = camera.lattice.lens_area / camera.lattice.cell_area
    shape = "round" if camera.mla_aperture == "circle" else camera.mla_lattice
    return [
        Row(group, "focal length", ", ".join(map(_text, camera.mla_focal_lengths)), "mm", ""),
        Row(group, "pitch", _text(camera.mla_pitch), "mm", ", ".join(lattice)),
        Row(group, "lens width", _text(camera.lattice.aperture_width), "mm", f"{shape}, {area:.0%} of the area"),
        Row(group, "lenses", f"{columns} x {rows}", "", bins),
        Row(group, "distance to detector", _text(camera.detector_distance), "mm", ""),
        Row(group, "f-number z/width", f"{micro:.3g}", "", ""),
        Row(group, "main lens's b/D1", f"{main:.3g}", "", match),
    ]


def _detector(camera: PlenopticCamera) -> list[Row]:
    group = "Detector"
    columns, rows = camera.resolution
    size = f"{_text(camera.detector_width)} x {_text(camera.detector_height)}"
    sheet = [
        Row(group, "size", size, "mm", ""),
        Row(group, "pixels", f"{columns} x {rows}", "", ""),
        Row(group, "pixel size", _text(1e3 * camera.pixel_size), "um", ""),
        Row(group, "pixels per lens", _text(camera.pixels_per_lens), "", "across its pitch"),
    ]
    if camera.is_cropped:
        window, offset = camera.crop_size, camera.crop_offset
        note = f"from column {offset[0]}, row {offset[1]}"
        sheet.append(Row(group, "recorded pixels", f"{window[0]} x {window[1]}", "", note))
    return sheet


def _micro_images(camera: PlenopticCamera) -> list[Row]:
    group = "Micro-images"
    pixel = camera.pixel_size
    diameter, pitch = camera.micro_image_diameter, camera.micro_image_pitch
    return [
        Row(group, "diameter", _text(diameter / pixel), "pixels", f"{_text(1e3 * diameter)} um, D1 z/b"),
        Row(group, "pitch", _text(pitch / pixel), "pixels", f"{_text(1e3 * pitch)} um, D2 (b + z)/b"),
        Row(group, "diameter over pitch", f"{diameter / pitch:.3g}", "", ""),
        Row(group, "mean of a white capture", f"{camera.white_mean:.3g}", "", "per unit radiance"),
    ]


def _refocusing(camera: PlenopticCamera, wavelength: float | None) -> list[Row]:
    group = "Refocusing"
    near, far = camera.refocus_range(wavelength)
    limit = "in a micro-image, by its pixels" if wavelength is None else "in a micro-image, with diffraction"
    rows = [
        Row(group, "directions told apart", f"{camera.direction_count(wavelength):.3g}", "", limit),
        Row(group, "nearest distance", *_distance(near), "with one sample per lens"),
        Row(group, "farthest distance", *_distance(far), ""),
    ]
    for distance in (near, camera.focus_distance, far):
        if camera.focal_length < distance < math.inf:
            at = f"at {_text(distance)} mm"
            rows += [
                Row(group, "bin size", _text(camera.bin_size(distance)), "mm", at),
                Row(
                    group,
                    "blur diameter",
                    _text(camera.blur_diameter(distance)),
                    "mm",
                    f"{at}, on the MLA",
                ),
            ]
    return rows


def _diffraction(camera: PlenopticCamera, wavelength: float) -> list[Row]:
    group = f"Diffraction at {wavelength:g} nm"
    spot = camera.spot_size(wavelength)
    pixels = f"{_text(spot / camera.pixel_size)} pixels, centre to first zero"
    return [
        Row(group, "spot of a microlens", _text(1e3 * spot), "um", pixels),
        Row(
            group,
            "directions by the spot",
            _text(camera.micro_image_diameter / spot),
            "",
            "across a micro-image",
        ),
        Row(
            group,
            "Fresnel number, microlens",
            f"{camera.mla_fresnel_number(wavelength):.3g}",
            "",
            "from the detector",
        ),
        Row(
            group,
            "Fresnel number, main lens",
            f"{camera.main_fresnel_number(wavelength):.3g}",
            "",
            "from the MLA",
        ),
    ]


def _distance(value: float) -> tuple[str, str]:
    """Write a distance and its unit, where there may be no such plane or it may be at infinity."""
    if value < 0:
        return "none", ""
    return ("infinity", "") if math.isinf(value) else (_text(value), "mm")


def _text(value: float) -> str:
    """Four digits, without an exponent for the sizes that cameras have."""
    return f"{value:.4g}"
