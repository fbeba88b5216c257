"""Warnings about the design of a camera as sentences, and the camera without these faults."""

import math
from collections.abc import Iterator

from ..camera import PlenopticCamera, micrometres
from ..prescription import SINGLE
from .aberration import parabolic_aberration
from .microscope import microscope_findings
from .quantities import (
    best_distances,
    best_images,
    crosstalk_lenses,
    direction_count,
    focus_type,
    lenses_across,
    micro_image_distance,
    mla_fresnel_number,
    mla_object_distances,
    spot_radius,
)
from .remedies import (
    Changes,
    Finding,
    changed_camera,
    detector_at,
    finer_pixels,
    in_millimetres,
    larger_lenses,
    least_change,
)


def design_warnings(camera: PlenopticCamera, wavelength: float | None = None) -> list[str]:
    """Return warnings about a camera's design, one sentence each with its remedies."""
    return [finding.sentence(camera) for finding in _findings(camera, wavelength)]


def mended(camera: PlenopticCamera, wavelength: float | None = None) -> PlenopticCamera:
    """Return the camera without warnings that takes the fewest changes, each the remedy of a warning.

    Of two such cameras, the one whose remedies are named first is taken. A camera without warnings remains as it is; if
    no remedies help, the camera with the fewest warnings is returned.

    Parameters
    ----------
    wavelength : float, optional
        Wavelength in nanometres, for warnings about diffraction.
    """
    best = camera
    fewest = math.inf
    tried = [camera]
    # The list grows as it is gone through: all cameras of one change come before those of two.
    for candidate in tried:
        findings = list(_findings(candidate, wavelength))
        if len(findings) < fewest:
            best = candidate
            fewest = len(findings)
        if not findings:
            break
        for finding in findings:
            for _, changed in finding.mended(candidate):
                # 60: Cameras that are tried to mend one.
                if changed not in tried and len(tried) < 60:
                    tried.append(changed)
    return best


def _findings(camera: PlenopticCamera, wavelength: float | None) -> Iterator[Finding]:
    """Yield the faults of a camera's design, with remedies."""
    yield from map(Finding, micrometres(camera))
    if not camera.refocuses:
        return
    if not camera.lens_data.converges:
        yield from microscope_findings(camera, wavelength)
        return
    yield from _sizes(camera)
    yield from _focus(camera)
    # 2e-4: Of detectors, in millimetres.
    if camera.pixel_size < 2e-4:
        yield Finding(
            f"a pixel is {camera.pixel_size:.3g} mm wide, less than a wavelength of light: lengths are taken as "
            "millimetres",
            (("if these are metres, multiply them by 1000", in_millimetres(camera)),),
        )
    directions = direction_count(camera, wavelength)
    if directions < 2 * (1 - SINGLE) and not _is_dual(camera):
        factor = 2 / directions * (1 + SINGLE)
        finer = ("make pixels finer", finer_pixels(camera, factor))
        larger = ("make lenses larger", larger_lenses(camera, factor))
        by_pixels = wavelength is None or camera.pixel_size >= spot_radius(camera, wavelength)
        yield Finding(
            f"no refocusing: across its diameter a micro-image resolves only {directions:.2g} directions",
            (finer, larger) if by_pixels else (larger,),
        )
    if wavelength is not None:
        yield from _diffraction(camera, wavelength)


def _is_dual(camera: PlenopticCamera) -> bool:
    """Return whether each lens has two pixels for the two sides of the pupil (a dual-pixel sensor)."""
    # 0.01: Largest relative deviation from two pixels across the lenses of dual and quad pixels.
    return abs(camera.pixels_per_lens / 2 - 1) <= 0.01


def _sizes(camera: PlenopticCamera) -> Iterator[Finding]:
    """Yield findings about the sizes of micro-images."""
    diameter = camera.micro_image_diameter
    pitch = micro_image_distance(camera)
    # The stop for which the micro-images just touch, and the distance of the detector.
    touching = camera.aperture_diameter * pitch / diameter
    width = 2 * camera.pupil_radius
    lens = camera.lattice.nearest_distance
    microlenses = detector_at(camera, lens * camera.pupil_distance / (width - lens)) if width > lens else None
    stop = {"aperture_radius": touching / 2}
    if diameter > pitch * (1 + SINGLE):
        yield Finding(
            f"micro-images overlap: their diameter of {diameter:.4g} mm exceeds their pitch of {pitch:.4g} mm",
            (
                ("take microlenses of shorter focal length and the detector nearer", microlenses),
                (f"stop the main lens down to a diameter of {touching:.6g} mm", stop),
            ),
        )
    elif diameter < 0.5 * pitch:
        yield Finding(
            f"pixels are wasted: micro-images fill {diameter / pitch:.0%} of their pitch",
            (
                ("take microlenses of longer focal length and the detector farther away", microlenses),
                (f"open the main lens to a diameter of {touching:.6g} mm", stop),
            ),
        )
    elif focus_type(camera) != "unfocused" and _rims_overlap(camera):
        z = camera.reduced_distance
        radius = camera.aperture_radius
        fill = camera.mla_fill

        def apart(changed: PlenopticCamera) -> bool:
            return not _rims_overlap(changed)

        yield Finding(
            "micro-images overlap at their rims, which a lens that is in focus on the object blurs: light of "
            "neighbouring lenses mixes there",
            (
                (
                    "take microlenses of shorter focal length and the detector nearer",
                    least_change(lambda factor: detector_at(camera, factor * z), camera, apart),
                ),
                (
                    "stop the main lens down",
                    least_change(lambda factor: {"aperture_radius": factor * radius}, camera, apart),
                ),
                ("narrow the lenses", least_change(lambda factor: {"mla_fill": factor * fill}, camera, apart)),
            ),
        )


def _rims_overlap(camera: PlenopticCamera) -> bool:
    """Return whether pixels would be lit through several lenses even with a pupil narrower by a part of a pixel."""
    # 0.5: Pixels by which rims of micro-images overlap unseen: no pixel gets half of its light from another lens.
    narrower = camera.aperture_radius - 0.5 * camera.pupil_step
    return narrower > 0 and crosstalk_lenses(camera.replace(aperture_radius=narrower)) > 1


def _focus(camera: PlenopticCamera) -> Iterator[Finding]:
    """Yield findings about the planes in focus."""
    image = max(best_images(camera))
    if image < camera.focal_length * (1 - SINGLE):
        farther = camera.mla_distance + camera.focal_length - image
        yield Finding(
            f"no object plane is in focus: the microlenses see a plane {image:.4g} mm behind the main lens, "
            f"within its focal length of {camera.focal_length:.4g} mm",
            (("lengthen mla_distance, here to focus at infinity", {"mla_distance": farther}),),
        )
    for distance, across in _gaps(camera).items():
        yield Finding(
            f"gaps at {distance:.4g} mm, where the microlenses are sharpest: the light of a point spans only "
            f"{across:.2g} of them",
            (
                ("open the main lens", {"aperture_radius": camera.aperture_radius / across} if across else None),
                ("move the detector so that they see farther", _seeing_farther(camera)),
            ),
        )


def _gaps(camera: PlenopticCamera) -> dict[float, float]:
    """Return the planes where focused microlenses leave gaps, with the number of lenses that a point lights."""
    if focus_type(camera) == "unfocused":
        return {}
    cones = {g: lenses_across(camera, g) for g in best_distances(camera) if camera.focal_length < g < math.inf}
    return {distance: across for distance, across in cones.items() if across < 1 - SINGLE}


def _seeing_farther(camera: PlenopticCamera) -> Changes:
    """Return the detector distance in mm, nearer the microlenses' focal length, at which lenses leave no gaps."""
    (a, *others) = mla_object_distances(camera)
    pitch = max(camera.mla_pitches)
    if others:
        # Of several types one sees the main lens where it is in focus, and farther than all where it nearly is.
        blurs = (sign * blur for blur in (1.5, 3, 6, 12) for sign in (1, -1))
        shares = (1 + blur * camera.pixel_size / camera.lattice.aperture_width for blur in blurs)
        distances = [share * camera.detector_distance for share in shares if share > 0]
    else:
        width = camera.aperture_diameter * (1 - SINGLE)
        reach = math.copysign(pitch * camera.mla_distance / (width + math.copysign(pitch, a)), a)
        power = 1 / camera.reduced_focal_lengths[0] - 1 / reach
        distances = [camera.mla_medium / power] if power > 0 and reach * a > 0 else []
    for distance in distances:
        changed = changed_camera(camera, {"detector_distance": distance})
        if changed is not None and not _gaps(changed):
            return {"detector_distance": distance}
    return None


def _diffraction(camera: PlenopticCamera, wavelength: float) -> Iterator[Finding]:
    """Yield findings about diffraction at one wavelength, and about aberrations."""
    spot = spot_radius(camera, wavelength)
    # Pixels of unfocused microlenses are to gather directions; those of others sample an image.
    if focus_type(camera) != "unfocused" and camera.pixel_size > 0.5 * spot * (1 + SINGLE):
        factor = 2 * camera.pixel_size / spot
        behind = detector_at(camera, factor * camera.reduced_distance)
        yield Finding(
            f"the detector undersamples the diffraction spot: a pixel of {1e3 * camera.pixel_size:.4g} um "
            f"exceeds half the spot's radius of {1e3 * spot:.4g} um",
            (
                ("make pixels finer", finer_pixels(camera, factor)),
                (
                    "stop the main lens down and take microlenses of longer focal length",
                    behind and {"aperture_radius": camera.aperture_radius / factor, **behind},
                ),
            ),
        )
    fresnel = mla_fresnel_number(camera, wavelength)
    # The spot is as wide as half a lens at 0.5, which keeps the sides of the pupil apart.
    least = 0.5 if _is_dual(camera) else 1
    if fresnel < least * (1 - SINGLE):
        yield Finding(
            f"the microlenses hardly focus: their Fresnel number is {fresnel:.2g}",
            (("make lenses larger", larger_lenses(camera, least / fresnel)),),
        )
    aberration = parabolic_aberration(camera, wavelength) if camera.lens_model == "parabolic" else 0
    # 0.25: Aberration in waves that is hardly seen, by Rayleigh's criterion.
    if aberration > 0.25:
        yield Finding(
            f"lens_model parabolic: the main lens aberrates light by {aberration:.2g} waves over the field",
            (("take a lens without aberrations", {"lens_model": "ideal"}),),
            "a smaller aperture_radius or detector_width lessens them",
        )
