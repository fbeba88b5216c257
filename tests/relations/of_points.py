"""Relations of light of points, by waves: units, symmetries, crops, the detector, and models against each other."""

from dataclasses import replace

import numpy as np
from camera_draws import OPTIONS, dimension_of, on_stage, scaled
from relation import image_of, off, relation
from scipy.ndimage import gaussian_filter

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.camera import PARAMETERS, parts_of, with_gradient, with_parts
from mitsuba_plenoptic.camera.entry import Captures, Use
from mitsuba_plenoptic.detector import SHARP, DetectorOperator
from mitsuba_plenoptic.views import white_image

IRREGULAR = "mla_jitter mla_seed mla_figure_error mla_transmissions"
"""What tells lenses apart by their indices."""

STRONG = {"main_lens", "aperture_blades", "mla_transmissions", "mla_warp", "mla_cra", "mla_tilt", "vignetting"}
"""Behind them patches miss up to 1.3 per cent of a spread, and bins are displaced, as the table of support states."""

AT_THE_LINE_D = "glass mla_glass"
"""Their focal lengths are those at a wavelength that has a name."""


def bound(draw, exact):
    options = set(draw.options)
    return 0.04 if {"mla_cra", "mla_focal_length"} <= options else 0.014 if STRONG & options else exact


def picture(camera, points, wavelength, weights=None, s=1.0):
    return image_of(camera, [tuple(s * np.array(point)) for point in points], s * wavelength, weights)


@relation(Use.POINTS, AT_THE_LINE_D)
def units(draw):
    """All lengths and the wavelength s times as long: the same picture."""
    if draw.camera.prescription is not None:
        return None
    points, s = [draw.point()], float(draw.rng.choice([0.6, 1.7]))
    other = mp.PlenopticCamera(**scaled(draw.parameters, s))
    return off(picture(other, points, draw.wavelength, s=s), picture(draw.camera, points, draw.wavelength)), 1e-3


def mirrored_options(draw):
    """Return the parameters of the camera as a mirror across x shows it."""
    p = dict(draw.parameters)
    signs = {
        "mla_offset": (-1, 1), "mla_tilt": (-1, 1), "mla_rotation": -1, "distortion": (1, 1, 1, 1, -1),
        "mla_warp": (-1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1), "wavefront": NOLL_SIGNS,
    }  # fmt: skip
    for name in set(signs) & set(p):
        value = np.asarray(p[name]) * np.asarray(signs[name])
        p[name] = tuple(value.tolist()) if value.ndim else float(value)
    if len(draw.camera.mla_focal_lengths or ()) == 3:
        p["mla_focal_length"] = tuple(p["mla_focal_length"][i] for i in (0, 2, 1))
    if "aperture_blades" in p:
        p["aperture_blades"] = (p["aperture_blades"][0], 180.0 - p["aperture_blades"][1])
    if "aperture_image" in p:
        p["aperture_image"] = mp.Aperture(np.asarray(p["aperture_image"].transmission)[:, ::-1])
    if "phase_screen" in p:
        p["phase_screen"] = mp.PhaseScreen(np.asarray(p["phase_screen"].waves)[:, ::-1], p["phase_screen"].width)
    if isinstance(p.get("stray_light"), mp.StrayLight):
        p["stray_light"] = mp.StrayLight(np.asarray(p["stray_light"].values)[:, ::-1])
    if "vignetting" in p:
        v, odd = p["vignetting"], np.array([1, -1, 1, 1, -1, 1])
        p["vignetting"] = replace(
            v, radius=(np.asarray(v.radius) * odd).tolist(), slope_x=(-np.asarray(v.slope_x) * odd[:3]).tolist()
        )
    if set(draw.options) & {"crop_offset", "crop_size"}:
        camera = draw.camera
        p["crop_size"] = camera.crop_size
        p["crop_offset"] = (camera.resolution[0] - camera.crop_offset[0] - camera.crop_size[0], camera.crop_offset[1])
    return p


NOLL_SIGNS = (1, -1, 1, 1, -1, 1, 1, -1, 1)
"""Of piston, x, y, defocus, xy, x^2 - y^2, y coma, x coma, y trefoil under x to -x, in Noll's order."""


@relation(Use.POINTS, IRREGULAR)
def mirror(draw):
    """Mirrored camera and point: the mirrored picture."""
    x, y, g = draw.point()
    other = picture(mp.PlenopticCamera(**mirrored_options(draw)), [(-x, y, g)], draw.wavelength)
    return off(other[:, ::-1], picture(draw.camera, [(x, y, g)], draw.wavelength)), bound(draw, 2e-3)


def same_array(draw):
    """Return the camera with its lattice turned or moved onto itself, its kinds of lenses too."""
    camera, kinds = draw.camera, len(draw.camera.mla_focal_lengths)
    if draw.rng.random() < 0.5:
        vector = kinds * draw.rng.integers(-2, 3, 2) @ np.array(camera.lattice.basis)
        return camera.replace(mla_offset=tuple((np.array(camera.mla_offset) + vector).tolist()))
    turn = 90.0 if camera.mla_lattice == "square" else 120.0 if kinds == 3 else 60.0
    if camera.mla_pitches[0] != camera.mla_pitches[1]:
        turn = 180.0 if kinds == 1 else 360.0
    return camera.replace(mla_rotation=camera.mla_rotation + turn)


@relation(Use.POINTS, f"{IRREGULAR} crop_offset crop_size")
def same_lattice(draw):
    """A lattice turned or moved onto itself: the same picture."""
    if not draw.camera.has_array:
        return None
    points = [draw.point()]
    pictures = [picture(camera, points, draw.wavelength) for camera in (same_array(draw), draw.camera)]
    return off(*pictures), bound(draw, 4e-3)


BY_PIXELS = {
    "point spreads by waves": lambda c, point, w: picture(c, [point], w),
    "point spreads by rays": lambda c, point, w: mp.point_spread_function(c, point, model="ray", wavelength=w),
    "full fields": lambda c, point, w: mp.point_spread_function(c, point, wavelength=w, method="full_field"),
    "white images": lambda c, point, w: white_image(c),
}
"""Computations of the same light on the pixels of a crop and of the whole detector."""

SAMPLED = {"main_lens", "vignetting", "mla_cra"}
"""Behind them white images are of few rays a pixel, and have their noise."""


@relation(
    Use.POINTS | Use.RAY_SPREADS | Use.FULL_FIELDS | Use.WHITE_IMAGES, "crop_offset crop_size stray_light stray_width"
)
def crop(draw):
    """A crop is the same pixels of the whole, but for what blur brings across its rim."""
    camera, point, computed = draw.camera, draw.point(), str(draw.rng.choice(list(BY_PIXELS)))
    if not camera.has_array and computed == "white images":
        return None

    def image(of):
        return np.squeeze(BY_PIXELS[computed](of, point, draw.wavelength)).astype(float)

    whole = image(camera)
    brightest = np.array(np.unravel_index(whole.argmax(), whole.shape))[::-1]
    n = whole.shape[0]
    size = np.array([n // 2, n // 2 + 3])
    offset = np.clip(brightest - size // 2 + draw.rng.integers(-n // 8, n // 8, 2), 0, n - size)
    part = image(camera.replace(crop_offset=tuple(offset.tolist()), crop_size=tuple(size.tolist())))
    rim = 8 if {"detector_blur", "pixel_crosstalk"} & set(draw.options) else 0
    inner = np.s_[rim : size[1] - rim, rim : size[0] - rim]
    limit = {"full fields": 0.005, "white images": 0.1 if SAMPLED & set(draw.options) else 1e-3}.get(computed, 1e-3)
    return off(part[inner], whole[offset[1] :, offset[0] :][: size[1], : size[0]][inner]), limit


@relation(Use.POINTS, "pixel_crosstalk stray_light stray_width crop_offset crop_size")
def blur(draw):
    """Blur of the detector is a Gaussian of the picture without it, if it is at least a pixel wide."""
    points, pixels = [draw.point()], float(draw.rng.uniform(1.0, 2.0))
    plain = draw.camera.replace(detector_blur=0.0)
    blurred = plain.replace(detector_blur=pixels * plain.pixel_size)
    expected = gaussian_filter(picture(plain, points, draw.wavelength), pixels, mode="reflect", truncate=8)
    return off(picture(blurred, points, draw.wavelength), expected), 1e-3


@relation(Use.POINTS)
def file(draw):
    """A camera read from JSON, or made anew from its dictionary: the same picture."""
    points = [draw.point()]
    others = [mp.PlenopticCamera.from_json(draw.camera.to_json()), mp.PlenopticCamera.from_dict(draw.camera.to_dict())]
    expected = picture(draw.camera, points, draw.wavelength)
    return max(off(picture(each, points, draw.wavelength), expected) for each in others), 1e-6


@relation(Use.POINTS)
def adjoint(draw):
    """Dot products of the sum of points and its adjoint agree."""
    operator = mp.CaptureOperator(draw.camera, [draw.point(), draw.point()], wavelength=draw.wavelength)
    weights, image = draw.rng.random(2), draw.rng.random(operator.image_shape)
    one = float(np.vdot(np.asarray(operator.forward(weights), float), image))
    return abs(float(np.vdot(weights, operator.adjoint(image))) / one - 1), 1e-5


LIMITS = {"aperture_radius": 0.25, "mla_fill": 0.25}
"""Of derivatives against differences, 0.06 else: samples of images follow the camera, and round edges most."""


def differentiable(camera):
    """Return the camera with numbers whose parameters have derivatives on both sides."""
    camera = camera.replace(detector_distance=camera.detector_distance)
    return camera.replace(mla_fill=0.95) if camera.has_array and camera.mla_fill > 0.98 else camera


def direction_of(camera, name, rng):
    """Return the values of a parameter, and a direction in which they may change."""
    value = parts_of(camera, name)
    # Round lenses are as wide as the shorter pitch, which has no derivative where both are the same.
    count = 1 if name == "mla_pitch" and camera.mla_aperture == "circle" else value.shape
    return value, value * rng.uniform(0.5, 1.5, count) if PARAMETERS[name].scale is None else value * 0 + 1.0


def directions_of(camera, rng, count=None):
    """Return values and directions of the parameters with a derivative that a camera has, or of some of them."""
    both = {name: direction_of(camera, name, rng) for name in with_gradient(Captures.POINTS)}
    names = [name for name, (value, _) in both.items() if value.size]
    return {name: both[name] for name in (rng.choice(names, count, replace=False).tolist() if count else names)}


@relation(Use.POINT_DERIVATIVES, "crop_offset crop_size")
def derivative(draw):
    """Derivatives by all parameters are limits of differences of captures, of which those to both sides agree."""
    camera, points = differentiable(draw.camera), [draw.point(0.5)]
    moves = directions_of(camera, draw.rng)
    operator = mp.CaptureOperator(camera, points, wavelength=draw.wavelength)
    slopes = operator.jacobian([1.0], [{name: direction} for name, (_, direction) in moves.items()])
    image, worst = picture(camera, points, draw.wavelength), []
    for slope, (name, (value, direction)) in zip(slopes, moves.items(), strict=True):
        step = 0.02 / (off(slope + image, image) or 1.0)
        ahead, behind = (
            (picture(with_parts(camera, {name: value + h * direction}), points, draw.wavelength) - image) / h
            for h in (step / 2, -step / 2)
        )
        limit = LIMITS.get(name, 0.06)
        # Differences that disagree by half of it may see that light is sampled in other ways.
        if np.any(ahead) and off(ahead, behind) < limit / 2:
            worst.append(off(slope, (ahead + behind) / 2) / limit)
            draw.slopes.append(name)
    return (max(worst), 1.0) if worst else None


@relation(
    Use.POINT_DERIVATIVES, method="derivatives behind a detector", first=lambda seed: on_stage(OPTIONS, "detector")
)
def product_rule(draw):
    """Derivatives of what pixels record are those of their light, as pixels mix it, and those of the mixing."""
    camera, points = differentiable(draw.camera), [draw.point(0.5)]
    moves = directions_of(camera, draw.rng, 3)
    both = camera, camera.replace(**SHARP)
    recorded, light = (mp.CaptureOperator(each, points, wavelength=draw.wavelength) for each in both)
    directions = [{name: direction} for name, (_, direction) in moves.items()]
    slopes, of_light = (each.jacobian([1.0], directions) for each in (recorded, light))
    image, worst = light.forward([1.0]), []
    for slope, plain, (name, (value, direction)) in zip(slopes, of_light, moves.items(), strict=True):

        def mixed(h, image, name=name, value=value, direction=direction):
            changed = with_parts(camera, {name: value + h * direction})
            return DetectorOperator.of(changed).forward(np.squeeze(image).astype(float))

        h = 1e-4 * float(np.abs(value).max() or 1.0)
        expected = mixed(0, plain) + (mixed(h, image) - mixed(-h, image)) / (2 * h)
        if np.any(expected):
            worst.append(off(slope, expected))
            draw.slopes.append(name)
    return (max(worst), 1e-5) if worst else None


@relation(Use.POINT_DERIVATIVES, f"{AT_THE_LINE_D} focus_distance crop_offset crop_size")
def euler(draw):
    """Derivatives times values of all lengths, points and the wavelength add up to none: pictures have no unit."""
    if draw.camera.prescription is not None:
        return None
    camera = draw.camera.replace(detector_distance=draw.camera.detector_distance)
    points, h = np.array([draw.point()]), 4e-4
    longer = {name: parts_of(camera, name) for name in with_gradient(Captures.POINTS) if dimension_of(name) == 1}
    # The aperture, whose round edge moves between samples, grows in the difference.
    longer = {name: value for name, value in longer.items() if value.size and name != "aperture_radius"}
    operator = mp.CaptureOperator(camera, points, wavelength=draw.wavelength, accuracy=0.0)
    by_camera = np.squeeze(operator.derivative([1.0], longer | {"wavelength": draw.wavelength})).astype(float)

    def grown(s):
        others = {name: value for name, value in scaled(draw.parameters, s).items() if name not in longer}
        return picture(camera.replace(**others), points * s, draw.wavelength)

    by_points = (grown(1 + h) - grown(1 - h)) / (2 * h)
    # Without an array fringes in a blur wider than the detector have derivatives that miss as the page states.
    return off(-by_camera, by_points), 0.12 if camera.has_array else 0.16


@relation(Use.POINT_DERIVATIVES)
def reverse(draw):
    """Forward and reverse derivatives agree, and so do their sums over pixels."""
    operator = mp.CaptureOperator(draw.camera, [draw.point()], wavelength=draw.wavelength)
    image = draw.rng.random(operator.image_shape)
    gradient = operator.gradient([1.0], image)
    name = str(draw.rng.choice(sorted(gradient)))
    direction = draw.rng.random(gradient[name].shape)
    slope = np.asarray(operator.derivative([1.0], {name: direction}), float)
    scale = float(np.linalg.norm(slope) * np.linalg.norm(image))
    return abs(float(np.vdot(slope, image)) - float(np.vdot(direction, gradient[name]))) / max(scale, 1e-300), 1e-4
