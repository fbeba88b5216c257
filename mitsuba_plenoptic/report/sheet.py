"""The design sheet: quantities that follow from a camera's parameters."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from .. import design
from ..camera import PlenopticCamera, Round
from ..errors import LONGEST
from ..lenses import RealLens, main_lens
from ..prescription import Collimator, Objective, conjugate_distance
from .lens_quality import FIELDS, FieldFigures, field_figures
from .pages import template


class Row(NamedTuple):
    """One quantity of the design sheet: name, value and unit.

    Attributes
    ----------
    group : str
        The heading that it stands below.
    quantity : str
        Its name.
    value, unit : str
        Its value and unit as text.
    note : str
        A remark; an empty text means none.
    """

    group: str
    quantity: str
    value: str
    unit: str = ""
    note: str = ""


# Rows without their group: tuples of quantity, value, unit and note as texts; unit and note may be left out.
_Lines = list[tuple[str, ...]]


def sheet_tables(camera: PlenopticCamera, wavelength: float | None = None) -> Markup:
    """Return the HTML of a camera's design sheet, a table for each group."""
    widgets: Any = template("comparison.html").module
    return Markup(widgets.sheet(design_sheet(camera, wavelength)))


def design_sheet(camera: PlenopticCamera, wavelength: float | None = None) -> list[Row]:
    """Return a camera's parameters and derived quantities as rows; diffraction only with a wavelength."""
    at = f"Diffraction at {wavelength or 0:g} nm"
    if (objective := camera.objective) is not None:
        groups = {"Objective": _objective(camera, objective)}
        groups["Array"] = _fourier(camera, objective) if objective.images_stop else _image(camera, objective)
        if wavelength is not None:
            groups[at] = _microscope_diffraction(camera, objective, wavelength)
        groups["Microlenses"] = _lattice(camera)
    elif isinstance(camera.main_lens, Collimator):
        groups = {"Telescope": _telescope(camera, wavelength), "Microlenses": _lattice(camera)}
    else:
        groups = {"Main lens": _main_lens(camera)}
        if camera.prescription is not None:
            lens = main_lens(camera)
            groups["Surfaces of the main lens"] = _surfaces(lens)
            for field in field_figures(lens, [part * lens.corner for part in FIELDS], camera.focus_distance):
                groups[f"Image {field.height:.4g} mm from the axis"] = _field(field)
        if camera.has_array:
            groups["Microlenses"] = _microlenses(camera)
    groups["Detector"] = _detector(camera)
    if "Main lens" in groups and camera.has_array:
        groups["Micro-images"] = _micro_images(camera)
        groups["Resolution"] = _resolution(camera, wavelength)
        groups["Refocusing"] = _refocusing(camera, wavelength)
        if wavelength is not None:
            groups[at] = _diffraction(camera, wavelength)
    return _rows(groups)


def _rows(groups: dict[str, _Lines]) -> list[Row]:
    """Return the lines of groups as rows."""
    return [Row(group, *line) for group, lines in groups.items() for line in lines]


def _main_lens(camera: PlenopticCamera) -> _Lines:
    behind = "microlenses" if camera.has_array else "detector"
    rows = [
        ("focal length", f"{camera.focal_length:.4g}", "mm"),
        ("diameter", f"{camera.aperture_diameter:.4g}", "mm", f"f/{camera.f_number:.3g}"),
        (f"distance to {behind}", f"{camera.mla_distance:.4g}", "mm"),
        ("focused distance", *_distance(camera.focus_distance), f"on the {behind}"),
        ("field of view", f"{design.field_of_view(camera):.3g}", "deg", "horizontal, full angle"),
    ]
    if 0 < camera.focus_distance < math.inf:
        width = design.field_width(camera, camera.focus_distance)
        rows.append(("field width", f"{width:.4g}", "mm", "in the focused plane"))
    if camera.lens_data.is_thin:
        rows.append(("lens model", camera.lens_model))
    else:
        note = "below, resolution and refocusing are those of a thin lens of this focal length"
        rows.append(("kind", "real", "", note if camera.has_array else ""))
    for name, glass in (("glass", camera.glass), ("glass of the microlenses", camera.mla_glass)):
        if glass is not None:
            rows.append((name, glass.name or glass.form, "", "focal lengths are those at 587.56 nm"))
    if camera.aperture != Round():
        rows.append(("open part of the aperture", f"{camera.aperture.share:.3g}", "", "of its circle"))
    if any(camera.distortion):
        rows.append(("distortion", _joined(camera.distortion), "", "k1, k2, k3, p1, p2; by rays only"))
    return rows + _aberrations(camera)


def _aberrations(camera: PlenopticCamera) -> _Lines:
    rows: _Lines = []
    if any(camera.wavefront):
        strength = math.sqrt(sum(coefficient**2 for coefficient in camera.wavefront[3:]))
        rows.append(("aberrations", f"{strength:.4g}", "waves", "root mean square at 633 nm, without tilt"))
    if (screen := camera.phase_screen) is not None:
        rows.append(("phase screen", f"{screen.waves.std():.4g}", "waves", "root mean square of its samples"))
    return rows


def lens_sheet(lens: RealLens, distance: float, heights: dict[float, float]) -> list[Row]:
    """Return what lens programs print of a lens, as rows; the arguments are what `behind_lens` returns."""
    fields = field_figures(lens, heights.values(), distance, frequencies=(10, 30, 50))
    # Of x, y and their slopes; in the least square the spots of all fields and wavelengths count alike.
    moments = np.nansum([np.cov(rays, bias=True) for field in fields for rays in field.rays.values()], axis=0)
    behind = lens.back_distance
    focus = conjugate_distance(lens.focal_length, distance) + lens.numbers.rear_principal
    best = behind + np.trace(moments, 2) / np.trace(moments[2:, 2:])
    diameter = lens.prescription.pupil_diameter or 2 * lens.aperture_radius
    groups = {"Lens": _surfaces(lens)}
    groups["Lens"] += [
        ("entrance pupil's diameter", f"{diameter:.6g}", "mm", f"f/{lens.focal_length / diameter:.4g}"),
        ("image plane", f"{behind:.6g}", "mm", "behind the last vertex"),
        ("paraxial focus", f"{focus:.6g}", "mm", "behind the last vertex"),
        ("best focus", f"{best:.6g}", "mm", "behind the last vertex, of least mean square spots"),
    ]
    for angle, field in zip(heights, fields, strict=True):
        rows = [("image height", f"{field.height:.6g}", "mm", "of the chief ray"), *_field(field)]
        for name, contrasts in zip(("tangential", "sagittal"), field.transfer, strict=True):
            values = ", ".join(f"{contrast:.3f}" for contrast in contrasts)
            rows.append((f"MTF, {name}", values, "", f"at 10, 30, 50 per mm, {lens.light:g} nm"))
        groups[f"Field of {angle:.4g} deg"] = rows
    return _rows(groups)


def _surfaces(lens: RealLens) -> _Lines:
    """Return lines with a real main lens's paraxial quantities."""
    cardinal = lens.numbers
    scale = lens.scale
    described = lens.prescription
    surfaces = f"{len(described.surfaces)} surfaces, scaled by {scale:.6g}"
    return [
        ("prescription", described.name or "without a name", "", surfaces),
        ("focal length", f"{lens.focal_length:.8g}", "mm", f"at {lens.light:g} nm"),
        ("back focal length", f"{scale * cardinal.back_focal:.6g}", "mm", "from the last vertex"),
        ("front principal plane", f"{scale * cardinal.front_principal:.6g}", "mm", "behind the first vertex"),
        ("rear principal plane", f"{scale * cardinal.rear_principal:.6g}", "mm", "behind the last vertex"),
        ("entrance pupil", f"{scale * cardinal.entrance_pupil:.6g}", "mm", "behind the first vertex"),
        ("exit pupil", f"{scale * cardinal.exit_pupil:.6g}", "mm", "behind the last vertex"),
        ("radius of the exit pupil", f"{lens.pupil.radius:.6g}", "mm"),
    ]


def _field(field: FieldFigures) -> _Lines:
    """Return lines on a real main lens at one height."""
    rows: _Lines = [
        (
            "spot",
            f"{1e3 * math.sqrt(rays[:2].var(axis=1).sum()):.4g}",
            "um",
            f"root mean square radius at {wavelength:g} nm",
        )
        for wavelength, rays in field.rays.items()
    ]
    rows += [("light", f"{field.light:.1%}", "", "of that on the axis"), ("distortion", f"{field.distortion:+.3%}")]
    if field.colour is not None and field.height > 0:
        rows.append(
            ("lateral colour", f"{1e3 * field.colour:+.3g}", "um", "line F (486 nm) farther out than C (656 nm)")
        )
    return rows


def _microlenses(camera: PlenopticCamera) -> _Lines:
    main = design.image_f_number(camera)
    micro = design.mla_f_number(camera)
    # Neighbouring micro-images touch where the two match, up to the factor (b + z)/b of their pitch.
    if math.isclose(micro, main, rel_tol=0.05):
        match = "matches: micro-images touch"
    else:
        match = "faster than a microlens: overlap" if main < micro else "slower than a microlens: gaps"
    bins = "also the bins of a reconstruction"
    if camera.lens_count != camera.bin_count:
        bins = f"in rows; a reconstruction has {camera.bin_count[0]} x {camera.bin_count[1]} bins"
    return [
        *_lattice(camera, bins),
        ("f-number z/width", f"{micro:.3g}"),
        ("main lens's b/D1", f"{main:.3g}", "", match),
    ]


def _lattice(camera: PlenopticCamera, bins: str = "") -> _Lines:
    columns, rows = camera.lens_count
    lattice = [f"{camera.mla_lattice} lattice"]
    if camera.mla_rotation:
        lattice.append(f"turned by {camera.mla_rotation:.4g} deg")
    if camera.mla_offset != (0, 0):
        lattice.append(f"moved by ({_joined(camera.mla_offset)}) mm")
    if any(camera.mla_tilt):
        lattice.append(f"tilted by ({_joined(camera.mla_tilt)}) deg")
    if camera.mla_warp:
        lattice.append(f"displaced by up to {camera.most_displaced[0] / camera.pixel_size:.4g} pixels")
    medium = []
    if camera.mla_medium != 1:
        medium = [("medium behind it", f"{camera.mla_medium:g}", "", "refractive index, by which z is divided below")]
    area = camera.lattice.lens_area / camera.lattice.cell_area
    shape = "round" if camera.mla_aperture == "circle" else camera.mla_lattice
    form = "" if camera.mla_shape is None else f"of the {camera.mla_shape.form.replace('_', ' ')} mla_shape"
    return [
        ("focal length", _joined(camera.mla_focal_lengths), "mm", form),
        ("pitch", _joined(dict.fromkeys(camera.mla_pitches), " x "), "mm", ", ".join(lattice)),
        ("lens width", f"{camera.lattice.aperture_width:.4g}", "mm", f"{shape}, {area:.0%} of the area"),
        ("lenses", f"{columns} x {rows}", "", bins),
        ("distance to detector", f"{camera.detector_distance:.4g}", "mm"),
        *medium,
    ]


def _joined(values: Iterable[float], by: str = ", ") -> str:
    return by.join(f"{value:.4g}" for value in values)


def _detector(camera: PlenopticCamera) -> _Lines:
    lines = [
        ("size", f"{camera.detector_width:.4g} x {camera.detector_height:.4g}", "mm"),
        ("pixels", "{} x {}".format(*camera.resolution)),
        ("pixel size", f"{1e3 * camera.pixel_size:.4g}", "um"),
    ]
    if camera.has_array:
        lines.append(("pixels per lens", f"{camera.pixels_per_lens:.4g}", "", "across its pitch"))
    if camera.is_cropped:
        note = "from column {}, row {}".format(*camera.crop_offset)
        lines.append(("recorded pixels", "{} x {}".format(*camera.crop_size), "", note))
    return lines


def _micro_images(camera: PlenopticCamera) -> _Lines:
    pixel = camera.pixel_size
    diameter = camera.micro_image_diameter
    pitch = camera.micro_image_pitch
    return [
        ("diameter", f"{diameter / pixel:.4g}", "pixels", f"{1e3 * diameter:.4g} um, D1 z/b"),
        ("pitch", f"{pitch / pixel:.4g}", "pixels", f"{1e3 * pitch:.4g} um, D2 (b + z)/b"),
        ("diameter over pitch", f"{diameter / pitch:.3g}"),
        (
            "mean of a white capture",
            f"{design.white_mean(camera):.3g}",
            "",
            "per unit radiance, of even lenses and pixels",
        ),
    ]


def _resolution(camera: PlenopticCamera, wavelength: float | None) -> _Lines:
    names = {"keplerian": "focused, Keplerian", "galilean": "focused, Galilean"}
    kinds = [names.get(kind, kind) for kind in dict.fromkeys(design.focus_types(camera))]
    rows: _Lines = [("kind of camera", "; ".join(kinds), "", _seen(camera))]
    limits_of_all = design.depth_ranges(camera, wavelength)
    lenses = camera.mla_focal_lengths
    for f2, best, limits in zip(lenses, design.best_distances(camera), limits_of_all, strict=True):
        lens_note = f"f2 = {f2:.4g} mm" if len(lenses) > 1 else ""
        rows.append(("sharpest distance", *_distance(best), lens_note))
        if camera.focal_length < best <= LONGEST:
            rows += _effective(camera, best, wavelength)
        note = "refocused" if design.focus_type(camera) == "unfocused" else "blur below a pixel or the spot, no gaps"
        rows.append(("depth range", *_range(limits), note))
    if len(lenses) > 1:
        together = [_range(limits)[0] for limits in _union(limits_of_all)]
        rows.append(("depth range, together", ", ".join(together) or "none", "mm" if together else ""))
    return rows


def _seen(camera: PlenopticCamera) -> str:
    """Return a sentence on the image that the microlenses see."""
    if design.focus_type(camera) == "unfocused":
        return "the microlenses see the main lens"
    distances = design.mla_object_distances(camera)
    where = [f"{abs(a):.4g} mm {'before' if a > 0 else 'behind'} them" for a in distances]
    return f"the microlenses see an image {', '.join(where)}"


def _effective(camera: PlenopticCamera, distance: float, wavelength: float | None) -> _Lines:
    """Return lines on the resolution at one distance."""
    finest = design.effective_resolution(camera, distance, wavelength)
    samples = f"along an axis; suits oversample = {design.suitable_oversample(camera, distance, wavelength)}"
    rows: _Lines = [
        ("effective resolution", f"{finest.columns:.0f} x {finest.rows:.0f}", "", "details across and down"),
        ("finest detail", f"{finest.line_width:.4g}", "mm", f"{finest.ratio:.3g} per pixel of the detector"),
        ("samples per lens", f"{finest.samples_per_lens:.3g}", "", samples),
    ]
    if design.focus_type(camera) != "unfocused":
        rows += [
            ("virtual depth", f"{design.virtual_depth(camera, distance):.3g}", "", "image to MLA over z"),
            ("lenses that see a point", f"{design.lenses_across(camera, distance):.3g}", "", "along an axis"),
        ]
    return rows


def _refocusing(camera: PlenopticCamera, wavelength: float | None) -> _Lines:
    near, far = design.refocus_range(camera, wavelength)
    limit = "in a micro-image, by its pixels" if wavelength is None else "in a micro-image, with diffraction"
    rows = [
        ("directions resolved", f"{design.direction_count(camera, wavelength):.3g}", "", limit),
        ("nearest distance", *_distance(near), "with one sample per lens"),
        ("farthest distance", *_distance(far)),
    ]
    for distance in _finite(camera, near, far):
        at = f"at {distance:.4g} mm"
        rows += [
            ("bin size", f"{camera.bin_size(distance):.4g}", "mm", at),
            ("blur diameter", f"{round(camera.blur_diameter(distance), 12):.4g}", "mm", f"{at}, on the MLA"),
        ]
    return rows


def _finite(camera: PlenopticCamera, near: float, far: float) -> list[float]:
    """Return the ends of the range of refocusing and the sharpest distances as far as they are imaged and finite."""
    distances = dict.fromkeys((near, *design.best_distances(camera), far))
    return [distance for distance in distances if camera.focal_length < distance <= LONGEST]


def _diffraction(camera: PlenopticCamera, wavelength: float) -> _Lines:
    spot = design.spot_radius(camera, wavelength)
    pixels = f"{spot / camera.pixel_size:.4g} pixels, centre to first zero"
    if camera.pixel_size > spot / 2:
        pixels += ", so that pixels average over it"
    rows: _Lines = [
        ("spot of a microlens", f"{1e3 * spot:.4g}", "um", pixels),
        ("directions by the spot", f"{camera.micro_image_diameter / spot:.4g}", "", "across a micro-image"),
        ("Fresnel number, microlens", f"{design.mla_fresnel_number(camera, wavelength):.3g}", "", "from the detector"),
        ("Fresnel number, main lens", f"{design.main_fresnel_number(camera, wavelength):.3g}", "", "from the MLA"),
    ]
    for distance in _finite(camera, *design.refocus_range(camera, wavelength)):
        limit = design.resolution_limit(camera, distance, wavelength)
        note = f"{limit.frequency / limit.lenses:.2g} times one sample a lens"
        if limit.in_focus:
            note = "in focus: the lens pitch decides, deconvolution does not help"
        rows.append(("resolution, deconvolved", f"{limit.frequency:.4g}", "lp/mm", f"at {distance:.4g} mm; {note}"))
    return rows


def _distance(value: float) -> tuple[str, str]:
    """Return a distance and its unit as texts; "infinity" and, for no plane, "none" have no unit."""
    if value < 0:
        return "none", ""
    return ("infinity", "") if math.isinf(value) else (f"{value:.4g}", "mm")


def _range(limits: tuple[float, float] | None) -> tuple[str, str]:
    """Return a range of distances and its unit as texts."""
    if limits is None:
        return "none", ""
    return " to ".join(_distance(limit)[0] for limit in limits), "mm"


def _union(ranges: list[tuple[float, float] | None]) -> list[tuple[float, float]]:
    """Return ranges of distances, nearest first, with overlapping ones joined."""
    union: list[tuple[float, float]] = []
    for near, far in sorted(limits for limits in ranges if limits is not None):
        if union and near <= union[-1][1]:
            union[-1] = union[-1][0], max(far, union[-1][1])
        else:
            union.append((near, far))
    return union


def _telescope(camera: PlenopticCamera, wavelength: float | None) -> _Lines:
    """Return the lines about a telescope with a collimator, as the fore-optics of a Shack-Hartmann sensor."""
    image = camera.blur_diameter(math.inf)
    # Angles before the telescope are smaller by the magnification of the pupil than those at the array.
    to_sky = math.degrees(image / camera.aperture_diameter / camera.reduced_distance) * 3600
    rows = [
        ("kind of camera", "Shack-Hartmann sensor", "", "array in the image of the pupil"),
        ("focal length", f"{camera.focal_length:.4g}", "mm"),
        ("diameter", f"{camera.aperture_diameter:.4g}", "mm", f"f/{camera.f_number:.3g}"),
        ("image of the pupil", f"{image:.4g}", "mm"),
        ("lenses across it", f"{image / camera.row_pitch:.4g}"),
        ("field of a lens", f"{camera.row_pitch * to_sky:.4g}", "arcsec", "within which a star moves in its cell"),
        ("pixel on the sky", f"{camera.pixel_size * to_sky:.4g}", "arcsec"),
    ]
    if wavelength is not None:
        spot = design.spot_radius(camera, wavelength)
        note = f"{spot / camera.pixel_size:.4g} pixels, centre to first zero, at {wavelength:g} nm"
        rows.append(("spot of a microlens", f"{1e3 * spot:.4g}", "um", note))
    return rows + _aberrations(camera)


def _objective(camera: PlenopticCamera, lens: Objective) -> _Lines:
    nearest, farthest = design.depth_of_field(camera)
    depths = "nothing is sharp" if math.isnan(nearest) else f"{1e3 * nearest:.4g} to {1e3 * farthest:.4g}"
    return [
        ("magnification", f"{lens.magnification:g}", "", f"{lens.image_aperture:.4g} NA in the native image"),
        ("numerical aperture", f"{lens.numerical_aperture:g}", "", f"up to {math.degrees(lens.half_angle):.3g} deg"),
        ("immersion", f"{lens.immersion:g}", "", "refractive index"),
        ("focal length", f"{lens.focal_length:.4g}", "mm", f"tube lens of {lens.tube_focal_length:.4g} mm"),
        ("stop", f"{2 * lens.stop_radius:.4g}", "mm", "diameter, in the back focal plane"),
        ("object seen", f"{1e3 * design.native_field(camera):.4g}", "um", "width"),
        ("depth of field", depths, "um", "by rays, of microlenses or by refocusing"),
    ]


def _image(camera: PlenopticCamera, lens: Objective) -> _Lines:
    micro = camera.reduced_distance / camera.lattice.aperture_width
    main = 1 / (2 * lens.image_aperture)
    pixel = camera.pixel_size
    # Levoy et al. 2006, section 3: as many planes as directions under a lens.
    step = 2 * camera.row_pitch / lens.blur_diameter(1)
    return [
        ("kind of camera", "light-field microscope", "", "array in the native image plane"),
        ("lens pitch in the object", f"{1e3 * camera.row_pitch / lens.magnification:.4g}", "um"),
        ("axial step", f"{1e3 * step:.4g}", "um", "of depth, by which the blur grows by a lens at either side"),
        ("f-number z/width", f"{micro:.3g}"),
        ("objective's M/2NA", f"{main:.3g}", "", "micro-images touch where the two match"),
        ("micro-image", f"{camera.micro_image_diameter / pixel:.4g}", "pixels", f"of {camera.row_pitch / pixel:.4g}"),
        (
            "mean of a white capture",
            f"{design.white_mean(camera):.3g}",
            "",
            "per unit radiance, of even lenses and pixels",
        ),
    ]


def _fourier(camera: PlenopticCamera, lens: Objective) -> _Lines:
    _, lit = design.lenses_in_stop(camera)
    outer = design.outermost_lens(camera)
    scale = camera.reduced_distance / lens.last_focal_length
    touching = design.touching_field_stop(camera)
    apart = f"in micro-images that touch at {2 * scale * touching / camera.pixel_size:.4g}"
    rows = [
        (
            "kind of camera",
            "Fourier light-field microscope",
            "",
            f"lens of {lens.last_focal_length:.4g} mm before the array",
        ),
        ("image of the stop", f"{lens.blur_diameter(0):.4g}", "mm"),
        ("lenses across it", f"{design.lenses_across_stop(camera):.3g}", "", f"{len(lit)} lit"),
        ("numerical aperture of a lens", f"{design.lens_aperture(camera):.4g}"),
        ("pixel in the object", f"{1e3 * camera.bin_size(0):.4g}", "um"),
        ("field stop", "none", "", f"micro-images touch with {touching:.4g} mm")
        if lens.field_stop is None
        else ("field stop", f"{2 * scale * lens.field_stop / camera.pixel_size:.4g}", "pixels", apart),
    ]
    if outer > 0:
        note = f"per um of depth, of the outermost whole lens, {outer:.4g} mm from the axis"
        rows.append(("parallax", f"{abs(design.parallax(camera, outer)):.4g}", "um", note))
    return rows


def _microscope_diffraction(camera: PlenopticCamera, lens: Objective, wavelength: float) -> _Lines:
    spot = design.spot_radius(camera, wavelength)
    rows: _Lines = [
        ("objective's limit", f"{2e6 * lens.numerical_aperture / wavelength:.4g}", "lp/mm", "2 NA over the wavelength"),
        ("spot of a microlens", f"{1e3 * spot:.4g}", "um", f"{spot / camera.pixel_size:.4g} pixels"),
    ]
    if lens.images_stop:
        aperture = design.lens_aperture(camera)
        depth = lens.immersion * wavelength * 1e-3 / aperture**2
        resolved = f"{1e3 * design.view_resolution(camera, wavelength):.4g} um"
        rows.append(("limit of a lens", f"{2e6 * aperture / wavelength:.4g}", "lp/mm", resolved))
        of_view = f"{1e3 * design.view_depth(camera, wavelength):.4g}"
        rows.append(("depth of field", of_view, "um", "of a lens, by diffraction and by pixels, from end to end"))
        step = f"{1e3 * design.depth_step(camera, wavelength):.4g}"
        rows.append(("depth step", step, "um", "that parallax of the outermost whole lens resolves"))
        shallow = 1e-3 * depth
        sample = "pixel"
    else:
        shallow = lens.immersion * camera.lattice.aperture_width**2 / (2 * lens.magnification**2 * wavelength * 1e-6)
        sample = "lens"
    for depth in (shallow, 2 * shallow, 4 * shallow):
        limit = design.resolution_limit(camera, 1.001 * depth, wavelength)
        note = f"at depths of {1e3 * depth:.4g} um; {limit.frequency / limit.lenses:.2g} times one sample a {sample}"
        rows.append(("resolution, deconvolved", f"{limit.frequency:.4g}", "lp/mm", note))
    return rows
