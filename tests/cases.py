"""Scenes, cameras, apertures and measures that tests and the cases of `tools/bench` share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.signal import fftconvolve

from mitsuba_plenoptic import Capture, PlenopticCamera, design, reconstruct, render_capture
from mitsuba_plenoptic.report.metrics import common_scale, image_metrics

Scene = dict[str, Any]
"""A description that `mi.load_dict` takes."""

PERIOD = 1.35
"""Of the bars, in millimetres."""

THIN_FOG = {"type": "homogeneous", "sigma_t": 0.01, "albedo": 0.5}
ABSORBING_FOG = {"type": "homogeneous", "sigma_t": math.log(2) / 240, "albedo": 0.0}


def film(columns: int, rows: int) -> Scene:
    """Describe a film of luminance that keeps every pixel to itself."""
    return {
        "type": "hdrfilm",
        "width": columns,
        "height": rows,
        "rfilter": {"type": "box"},
        "pixel_format": "luminance",
        "component_format": "float32",
    }


def sensor(lenses: int = 32, pixels: int = 16, **parameters: Any) -> Scene:
    """Describe the paper's camera with fewer lenses and coarser pixels."""
    size = lenses * pixels
    return {"type": "plenoptic", "detector_width": 0.064 * lenses, "film": film(size, size), **parameters}


def scene_of(sensor: Scene, integrator: str | Scene = "path", **objects: Any) -> Any:
    """Return a scene; `integrator` is a name or a dictionary."""
    integrator = {"type": integrator} if isinstance(integrator, str) else integrator
    return mi.load_dict({"type": "scene", "integrator": integrator, "camera": sensor, **objects})


def facing(
    distance: float, size: Any, place: tuple[float, float] = (0.0, 0.0), to_world: Any = None, **extra: Any
) -> Scene:
    """Describe a rectangle that faces the camera: half its width, or both halves, and where its centre is."""
    T = mi.ScalarTransform4f()
    size = size if isinstance(size, tuple) else (size, size)
    own = T.translate([*place, distance]) @ T.rotate([0, 1, 0], 180) @ T.scale([*size, 1])
    return {"type": "rectangle", "to_world": own if to_world is None else to_world @ own, **extra}


def radiating(radiance: float = 1.0) -> Scene:
    """Describe an emitter, and a surface that reflects nothing."""
    return {"emitter": {"type": "area", "radiance": radiance}, "bsdf": {"type": "diffuse", "reflectance": 0.0}}


def line(middle: float, half: float) -> tuple[np.ndarray, np.ndarray, Scene]:
    """Return a spectrum that is 1 in a narrow band, as a table and as Mitsuba takes it."""
    rows = [(400, 0), (middle - half - 0.1, 0), (middle - half, 1), (middle + half, 1), (middle + half + 0.1, 0)]
    wavelengths, values = np.array([*rows, (700, 0)], float).T
    words = (",".join(map(str, each)) for each in (wavelengths, values))
    return wavelengths, values, {"type": "irregular", **dict(zip(("wavelengths", "values"), words, strict=True))}


def bars(distance: float, to_world: Any = None) -> Scene:
    """Describe upright radiating bars."""
    return {
        f"bar_{i}": facing(distance, (PERIOD / 4, 6.0), ((i + 0.25) * PERIOD, 0.0), to_world, **radiating())
        for i in range(-5, 6)
    }


MIRROR = {"type": "conductor", "material": "none"}


def turned_plane(bsdf: Scene) -> tuple[Scene, Any]:
    """Describe a plane at 240 mm, turned by 10 degrees, and the transform of what stands in its mirror image."""
    T = mi.ScalarTransform4f()
    plane = T.translate([0, 0, 240]) @ T.rotate([0, 1, 0], 10)
    shape = {"type": "rectangle", "to_world": plane @ T.rotate([0, 1, 0], 180) @ T.scale(20.0), "bsdf": bsdf}
    return shape, plane @ T.scale([1, 1, -1]) @ plane.inverse()


PANES = {
    "transparent mask": {"type": "mask", "opacity": 0.0, "nested": {"type": "diffuse"}},
    "null": {"type": "null"},
    "thindielectric": {"type": "thindielectric"},
    "half-open mask": {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse", "reflectance": 0.0}},
}


def bars_through(way: str, lenses: int = 32) -> Any:
    """Return the scene of bars that are 300 mm away, as the camera sees them, through something at 240 mm."""
    camera = sensor(lenses, focus_distance=270.0)
    if way == "directly":
        return scene_of(camera, **bars(300.0))
    if way in PANES:
        return scene_of(camera, pane=facing(240.0, 20.0, bsdf=PANES[way]), **bars(300.0))
    T = mi.ScalarTransform4f()
    if way == "mirror":
        mirror, there = turned_plane(MIRROR)
        return scene_of(camera, mirror=mirror, **bars(300.0, there))
    cube = {"type": "cube", "to_world": T.translate([0, 0, 240]) @ T.scale([20, 20, 10])}
    if way == "slab":
        # A slab of index n lets what is behind it seem nearer by its thickness times 1 - 1 / n.
        slab = {**cube, "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}
        return scene_of(camera, slab=slab, **bars(300.0 + 20 / 3))
    if way == "fog":
        return scene_of(camera, "volpath", fog={**cube, "bsdf": {"type": "null"}, "interior": THIN_FOG}, **bars(300.0))
    raise ValueError(way)


def slanted(pane: str | None) -> Any:
    """Return the scene of a radiating half plane, out of focus and seen at 5 degrees, maybe through a turned pane."""
    T = mi.ScalarTransform4f()
    turned = T.translate([0, 0, 256]) @ T.rotate([1, 0, 0], 85) @ T.translate([0, -20, 0])
    plane = {"type": "rectangle", "to_world": turned @ T.rotate([0, 1, 0], 180) @ T.scale(20.0), **radiating()}
    panes = {}
    if pane:
        to_world = T.translate([0, 0, 195]) @ T.rotate([1, 0, 0], 30) @ T.translate([0, 0, -195])
        panes["pane"] = facing(195.0, 20.0, to_world=to_world, bsdf=PANES[pane])
    return scene_of(sensor(16), plane=plane, **panes)


def contrast(capture: Capture, distance: float) -> float:
    """Return the modulation of the bars, at their period, in the image refocused at a distance."""
    image = reconstruct(capture, distance).image
    columns = image[4:-4].mean(axis=0)
    x = (np.arange(len(columns)) + 0.5 - len(columns) / 2) * capture.camera.bin_size(distance)
    # A whole number of periods
    half = math.floor(x[-2] / PERIOD) * PERIOD
    inside = np.abs(x) <= half
    wave = np.exp(2j * np.pi * x[inside] / PERIOD)
    return float(2 * abs((columns[inside] * wave).mean()) / columns[inside].mean())


def by_signed_rays(scene: Any, spp: int = 64, **options: Any) -> Capture:
    """Return the wave capture of a scene from signed rays."""
    return render_capture(scene, model="wave", method="signed_rays", spp=spp, **options)


def captures(scene: Any, spp: int = 64) -> tuple[Capture, Capture]:
    """Return the ray and the wave capture of a scene."""
    return render_capture(scene, model="ray", spp=2 * spp), by_signed_rays(scene, spp)


def energy(by_rays: Capture, by_waves: Capture) -> float:
    """Return the sum of the wave capture over that of the ray capture."""
    return float(by_waves.image.sum(dtype=float) / by_rays.image.sum(dtype=float))


def square_behind(pane: Scene | None = None) -> Any:
    """Return the scene of a square at 240 mm behind a card at 210 mm."""
    card = {} if pane is None else {"pane": facing(210.0, 20.0, bsdf=pane)}
    return scene_of(sensor(16, 16), square=facing(240.0, 0.4, (0.1, -0.1), **radiating()), **card)


TRANSPARENT = {
    "mask": PANES["transparent mask"],
    "null": PANES["null"],
    "thindielectric": {"type": "thindielectric", "int_ior": 1.0, "ext_ior": 1.0},
}
"""Cards that change nothing."""


def card_before(lenses: int = 16, aperture_radius: float = 5.0, **background: Scene) -> Any:
    """Return the scene of a black card, in focus at 1000 mm, that hides the left half of what is behind it."""
    card = facing(1000.0, 100.0, (100.0, 0.0), bsdf={"type": "diffuse", "reflectance": 0.0})
    camera = sensor(lenses, 16, focus_distance=1000.0, aperture_radius=aperture_radius)
    return scene_of(camera, card=card, **background)


def in_fog() -> Any:
    """Return the scene of a wall in a fog that absorbs half of its light."""
    wall = facing(240.0, 20.0, exterior=ABSORBING_FOG, **radiating())
    return scene_of(sensor(8, 16, medium=ABSORBING_FOG), "volpath", wall=wall)


def lamp_behind_glass(hide_emitters: bool) -> Any:
    """Return the scene of a lamp behind a pane of glass and beside it."""
    integrator = {"type": "path", "hide_emitters": hide_emitters}
    glass = {"type": "cube", "bsdf": {"type": "dielectric"}}
    glass["to_world"] = mi.ScalarTransform4f().translate([10, 0, 210]).scale([10, 20, 2])
    return scene_of(sensor(8, 16), integrator, glass=glass, lamp=facing(240.0, 20.0, **radiating()))


def lit_mirror(max_depth: int) -> Any:
    """Return the scene of a mirror that shows a lamp and a wall lit by another."""
    mirror, there = turned_plane(MIRROR)
    return scene_of(
        sensor(8, 16),
        {"type": "path", "max_depth": max_depth},
        mirror=mirror,
        lamp=facing(300.0, 10.0, (-10.0, 0.0), there, **radiating()),
        wall=facing(300.0, 10.0, (10.0, 0.0), there, bsdf={"type": "diffuse", "reflectance": 0.8}),
        light={"type": "point", "position": [-10.0, 25.0, 225.0], "intensity": 4e3},
    )


def plastic(lenses: int = 16) -> Any:
    """Return the scene of a smooth plastic, dimly lit, that shows radiating bars."""
    plane, there = turned_plane({"type": "plastic", "diffuse_reflectance": 0.02})
    light = {"type": "point", "position": [0.0, 30.0, 100.0], "intensity": 1e4}
    return scene_of(sensor(lenses, 16), plane=plane, light=light, **bars(300.0, there))


def half_lit(bsdf: Scene | None, angle: float) -> Any:
    """Return the scene of a reflecting plane in focus that shows half of the pupil a lamp, whose edge has an angle.

    The lamp is behind the camera and begins at the axis. Without a BSDF it stands, in place of the plane, where a
    mirror shows it.
    """
    T = mi.ScalarTransform4f()
    to_world = T.translate([0, 0, -10]) @ T.rotate([0, 0, 1], angle) @ T.translate([100, 0, 0]) @ T.scale(100)
    if bsdf is None:
        there = T.translate([0, 0, 480]) @ T.scale([1, 1, -1])
        return scene_of(sensor(8, 16), lamp={"type": "rectangle", "to_world": there @ to_world, **radiating()})
    lamp = {"type": "rectangle", "to_world": to_world, **radiating()}
    return scene_of(sensor(8, 16), plane=facing(240.0, 20.0, bsdf=bsdf), lamp=lamp)


# -- apertures of ordinary cameras, as parameters and as functions of the pupil that are written here again --

Mask = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Power that passes at coordinates over the pupil's radius."""


def picture(values: np.ndarray) -> tuple[dict[str, Any], Mask]:
    """Return an aperture of square cells, in rows of rising y and columns of rising x."""
    count = len(values)

    def power(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        column, row = (np.clip(((place + 1) / 2 * count).astype(int), 0, count - 1) for place in (x, y))
        return np.asarray(values[row, column] * (np.hypot(x, y) <= 1))

    return {"aperture_image": values}, power


def polygon(count: int, angle: float = 15.0) -> tuple[dict[str, Any], Mask]:
    """Return an aperture of blades, by the distances of its sides from the centre."""
    normals = math.radians(angle) + (np.arange(count) + 0.5) * 2 * math.pi / count

    def power(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        inside = [x * math.cos(each) + y * math.sin(each) <= math.cos(math.pi / count) for each in normals]
        return np.all(inside, axis=0).astype(float)

    return {"aperture_blades": (count, angle)}, power


def _cells(count: int, is_open: Mask) -> np.ndarray:
    """Return which cells, by their centres over the radius of the circle, are open."""
    centres = (2 * np.arange(count) + 1) / count - 1
    return np.asarray(is_open(*np.meshgrid(centres, centres)) * 1.0)


def opening(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the power that passes a round pupil at coordinates over its radius."""
    return (np.hypot(x, y) <= 1) * 1.0


def _random(count: int, chance: float, seed: int) -> np.ndarray:
    """Return cells that are open at random."""
    return (np.random.default_rng(seed).random((count, count)) < chance) * _cells(count, opening)


def _some(count: int, number: int, seed: int) -> np.ndarray:
    """Return a number of open cells at random places."""
    values = np.zeros(count * count)
    inside = np.flatnonzero(_cells(count, opening))
    values[np.random.default_rng(seed).permutation(inside)[:number]] = 1
    return values.reshape(count, count)


APERTURES = {
    "5 blades": polygon(5),
    "6 blades": polygon(6),
    "9 blades": polygon(9),
    "7 x 7": picture(_random(7, 0.5, 2)),
    "11 x 11": picture(_random(11, 0.5, 3)),
    "11 x 11 with 33 open": picture(_some(11, 33, 5)),
    "33 x 33 with 33 open": picture(_some(33, 33, 7)),
    "two holes": picture(_cells(9, lambda x, y: (abs(abs(x) - 2 / 3) < 0.1) & (abs(y) < 0.1))),
    "slit": picture(_cells(9, lambda x, y: (abs(x) < 0.1) & (abs(y) < 0.8))),
    "annulus": picture(_cells(63, lambda x, y: (np.hypot(x, y) <= 1) & (np.hypot(x, y) > 0.7))),
    "hole off centre": picture(_cells(63, lambda x, y: np.hypot(x - 0.5, y - 0.3) < 0.3)),
    # Files keep four decimals.
    "grey": picture(np.random.default_rng(4).random((9, 9)).round(4) * _cells(9, opening)),
}
"""Parameters of the camera, and the same as a function, by name."""


# -- ordinary cameras, what they see, and what diffraction makes of it: sums over the pupil without the package --
# Columns of a capture count along +x of the camera frame on the detector, and rows along +y.

ORDINARY_WAVELENGTH = 550.0
AIRY_RADIUS = 0.60983
"""Radius of the Airy disc in lambda b / R."""

_REACH, WIDE = 24.0, 40.0
"""Distances in lambda b / R beyond the detector to which walls extend, and to which points spread."""

_PUPIL = 693
"""Samples across the pupil, which cells of apertures divide."""


def ordinary_camera(airy: float, size: int = 48, **parameters: Any) -> PlenopticCamera:
    """Return an f/20 camera of square films whose pixels are some radii of the Airy disc wide."""
    camera = PlenopticCamera(mla_lattice="none", aperture_radius=2, mla_distance=120, resolution=(size, size))
    return camera.replace(detector_width=size * airy * AIRY_RADIUS * unit_of(camera), **parameters)


def unit_of(camera: PlenopticCamera) -> float:
    """Return lambda b / R in millimetres."""
    return ORDINARY_WAVELENGTH * 1e-6 * camera.mla_distance / camera.aperture_radius


def blurred(camera: PlenopticCamera, blur: float) -> tuple[float, float]:
    """Return the distance of an object whose geometric blur has a radius in lambda b / R, and of its image."""
    image = camera.mla_distance / (1 + blur * unit_of(camera) / camera.aperture_radius)
    return 1 / (1 / camera.focal_length - 1 / image), image


def seen(camera: PlenopticCamera, picture: np.ndarray, side: float, blur: float, **others: Any) -> mi.Scene:
    """Return a scene with a radiating square, whose image is centred and `side` mm wide on the detector."""
    distance, _ = blurred(camera, blur)
    data = mi.Bitmap(np.ascontiguousarray(picture[::-1, :, None], np.float32))
    radiance = {"type": "bitmap", "bitmap": data, "filter_type": "nearest", "raw": True}
    half = side / 2 * distance / camera.mla_distance
    square = facing(distance, half, emitter={"type": "area", "radiance": radiance})
    return scene_of(camera.to_sensor(), "direct", square=square, **others)


def point_spread(
    camera: PlenopticCamera, along: np.ndarray, blur: float, path: Any = None, mask: Mask = opening
) -> np.ndarray:
    """Return the light of a point at detector positions in mm, as |sum over the pupil|^2, in parts of a round pupil's.

    `path` is a function of the pupil's coordinates over its radius: the aberrations in waves. Light beyond the places
    is added in proportion, as walls end there, and evenly behind other masks, whose walls go on.
    """
    _, image = blurred(camera, blur)
    pupil = (np.arange(_PUPIL) + 0.5) / _PUPIL * 2 - 1
    x, y = np.meshgrid(pupil, pupil)
    square = (x * x + y * y) * camera.aperture_radius**2
    waves = square / (2 * ORDINARY_WAVELENGTH * 1e-6) * (1 / camera.mla_distance - 1 / image)
    if path is not None:
        waves = waves + path(x, y)
    power, place = mask(x, y), along / unit_of(camera)
    phases = np.exp(-2j * np.pi * np.outer(place, pupil))
    spread = np.abs(phases @ (np.sqrt(power) * np.exp(2j * np.pi * waves)) @ phases.T) ** 2
    spread *= (2 / _PUPIL) ** 2 * (place[1] - place[0]) ** 2 / np.count_nonzero(opening(x, y))
    if mask is opening:
        return np.asarray(spread / spread.sum())
    return np.asarray(spread + (power.sum() / opening(x, y).sum() - spread.sum()) / spread.size)


def diffracted(
    camera: PlenopticCamera, picture: np.ndarray, texel: int, blur: float, path: Any = None, mask: Mask = opening
) -> np.ndarray:
    """Return the capture of a picture whose texels are whole pixels wide, by a convolution on a finer grid.

    `picture` is seen as a capture shows it, and is centred on the detector. See `point_spread`.
    """
    fine = max(4, math.ceil(8 * camera.pixel_size / unit_of(camera)))
    step = camera.pixel_size / fine
    reach = int((WIDE + abs(blur)) * unit_of(camera) / step)
    spread = point_spread(camera, np.arange(-reach, reach + 1) * step, blur, path, mask)
    image = np.kron(picture, np.ones((texel * fine,) * 2))
    whole = fftconvolve(image, spread, mode="same")
    size, first = camera.resolution[0], (len(image) - camera.resolution[0] * fine) // 2
    part = whole[first : first + size * fine, first : first + size * fine]
    return part.reshape(size, fine, size, fine).mean((1, 3))


def texture_of(camera: PlenopticCamera, texel: int, blur: float, reach: float = _REACH) -> np.ndarray:
    """Return a random picture whose texels are some pixels wide, and that reaches beyond the detector."""
    side = camera.detector_width + 2 * (reach + abs(blur)) * unit_of(camera)
    count = 2 * math.ceil(side / (2 * texel * camera.pixel_size))
    return np.random.default_rng(3).random((count, count))


def textured_wall(
    camera: PlenopticCamera, texel: int, blur: float, reach: float = _REACH
) -> tuple[mi.Scene, np.ndarray]:
    """Return a scene with a textured wall, and its picture for `diffracted`."""
    picture = texture_of(camera, texel, blur, reach)
    return seen(camera, picture, len(picture) * texel * camera.pixel_size, blur), picture


# -- white walls and ramps that fill a camera's view, at a distance or as the sky --

WALLS = ("white", "ramp")
WALL_WAVELENGTH = 633.0
SLOPE = 0.5
"""Radiance by which a ramp rises over half the field."""

_RAMP_END = 1.9
"""Half width of a ramp over that of the field: beyond, its radiance stays what it is there, above zero."""

_MARGIN = 2.0
"""By how many half fields a wall extends beyond what rays see: diffraction brings light from there."""

_SKY_TEXELS = 8192


def wall_radiance(slope: np.ndarray, wall: str) -> np.ndarray:
    """Radiance at places in units of half the field, to the left of its middle."""
    return 1 + SLOPE * np.clip(slope, -_RAMP_END, _RAMP_END) if wall == "ramp" else np.ones_like(slope)


def known_radiance(camera: PlenopticCamera, wall: str) -> np.ndarray:
    """Radiance of a wall in each column of bins."""
    columns = camera.bin_count[0]
    # +x, to which the radiance rises, is left.
    return wall_radiance(1 - 2 * (np.arange(columns) + 0.5) / columns, wall)


def wall_capture(camera: PlenopticCamera, distance: float, wall: str, model: str, spp: int) -> Capture:
    """Capture a wall, or for an infinite distance a sky."""
    half = camera.bin_count[0] / 2 * camera.row_pitch / camera.mla_distance
    blur = camera.blur_diameter(distance) / 2 / camera.mla_distance
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": camera.to_sensor(),
        "wall": _sky(half, wall) if math.isinf(distance) else _wall(half, distance, 1 + blur / half + _MARGIN, wall),
    }
    options = {"wavelength": WALL_WAVELENGTH} if model == "wave" else {}
    return render_capture(mi.load_dict(scene), model=model, spp=spp, **options)


def _wall(half: float, distance: float, halves: float, wall: str) -> dict[str, Any]:
    size = halves * half * distance
    texels = 2 * math.ceil(128 * halves)
    slope = halves * (2 * (np.arange(texels) + 0.5) / texels - 1)
    turned = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([0, 1, 0], 180).scale([size, size, 1])
    # A rectangle that is turned to the camera has its u along -x.
    texture = {"type": "bitmap", "bitmap": _bitmap(wall_radiance(-slope, wall), 4), "raw": True}
    return {
        "type": "rectangle",
        "to_world": turned,
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": texture},
    }


def _sky(half: float, wall: str) -> dict[str, Any]:
    angle = 2 * math.pi * (np.arange(_SKY_TEXELS) + 0.5) / _SKY_TEXELS
    # Mitsuba's longitude runs from -z by +x; ahead is +z.
    slope = np.where(np.cos(angle) < 0, -np.tan(angle) / half, 0)
    return {"type": "envmap", "bitmap": _bitmap(wall_radiance(slope, wall), 64)}


def _bitmap(line: np.ndarray, rows: int) -> Any:
    return mi.Bitmap(np.repeat(np.tile(line, (rows, 1))[..., None], 3, axis=2).astype(np.float32))


# -- measures of images --


def relative(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the relative difference in the L2 norm."""
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


def agreement(
    images: Sequence[np.ndarray], references: Sequence[np.ndarray]
) -> tuple[float, list[tuple[float, float]]]:
    """Return the `common_scale` of images, and then the PSNR in dB and the correlation of each with its reference."""
    scale = common_scale(images, references)
    scores = [
        (image_metrics(scale * image, reference).psnr, float(np.corrcoef(image.ravel(), reference.ravel())[0, 1]))
        for image, reference in zip(images, references, strict=True)
    ]
    return scale, scores


def spot_filtered(image: np.ndarray, camera: PlenopticCamera, wavelength: float = 633.0) -> np.ndarray:
    """Convolve a capture with the spot of a square lens, whose transfer function is a triangle along each axis."""
    size = 2 * image.shape[0]
    frequency = np.fft.fftfreq(size, camera.pixel_size)
    triangle = (1 - np.abs(frequency) * design.spot_radius(camera, wavelength)).clip(min=0)
    spectrum = np.fft.rfft2(image, (size, size))
    spectrum *= triangle[:, None] * triangle[: size // 2 + 1]
    return np.fft.irfft2(spectrum, (size, size))[: image.shape[0], : image.shape[1]]
