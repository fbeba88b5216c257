"""Small cameras of many kinds, points before them, scenes as files and films, and how far images are apart."""

import mitsuba as mi
import numpy as np
import pytest
from cases import relative

from mitsuba_plenoptic import CaptureOperator, Objective, PlenopticCamera, Vignetting, render_capture, scene_path
from mitsuba_plenoptic.array import Conic
from mitsuba_plenoptic.lenses.fitted_lens import FittedLens
from mitsuba_plenoptic.lenses.pupil import Pupil
from mitsuba_plenoptic.lenses.pupil_fit import PupilRays, Pupils, fit_pupil
from mitsuba_plenoptic.lenses.thin import ThinLens

_SCENE = """<scene version="3.0.0">
<integrator type="path"/>
<sensor type="plenoptic">
{sensor}
<film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="64"/>
<rfilter type="{rfilter}"/><string name="pixel_format" value="{pixel_format}"/>
<string name="component_format" value="float32"/></film>
</sensor>
{text}
</scene>"""

BUILT_IN = [
    pytest.param(name, marks=pytest.mark.needs_extension("laser")) if name == "speckle" else name
    for name in sorted(path.stem for path in scene_path("letters").parent.glob("*.xml"))
]
"""Names of the built-in scenes, one of which has a laser."""

SMALL_SENSOR = '<float name="detector_width" value="0.128"/>'
"""Two lenses across, for scenes that are rendered."""


def write_scene(folder, text='<emitter type="constant"/>', *, sensor="", rfilter="box", pixel_format="luminance"):
    """Write a scene file with these texts in its sensor and behind it, and return its path."""
    path = folder / "scene.xml"
    path.write_text(_SCENE.format(text=text, sensor=sensor, rfilter=rfilter, pixel_format=pixel_format))
    return path


def letters(lenses, **parameters):
    """Return the parameters that show the letters, as large in the picture as the paper's, on so many lenses across."""
    small = {"resolution": 32 * lenses, "detector_width": 0.064 * lenses, "letter_scale": lenses / 128}
    return {name: str(value) for name, value in (small | parameters).items()}


def definitions(parameters):
    """Return the words by which the command is given parameters of a scene."""
    return [word for name, value in parameters.items() for word in ("-D", f"{name}={value}")]


def disk(position, radius, **extra):
    """Describe a disk that faces the camera, and radiates unless it has another emitter."""
    return {
        "type": "disk",
        "to_world": mi.ScalarTransform4f().translate(position).rotate([0, 1, 0], 180).scale(radius),
        "emitter": {"type": "area", "radiance": 1.0},
        **extra,
    }


ACROSS = (0.5, -0.4, 0.3, 0.5, -0.35, 0.25, 0.2, 0.3, -0.2, 0.1, 0.2, 0.3, 0.4, 0.1, -0.3, 0.5, -0.6, 0.2)
UP = (-0.3, 0.5, 0.4, -0.3, 0.5, 0.2, -0.35, 0.1, 0.3, -0.2, 0.2, -0.3, 0.1, 0.5, 0.2, -0.4, 0.3, 0.6)
"""Coefficients of displacements over positions from -1 to 1: of x^2, xy, y^2, x^3 ... y^5."""


def warped(camera, farthest, terms=7):
    """Return the camera with lenses displaced by up to so many pixels, and the displacement as a function."""
    half = camera.detector_width / 2
    powers = np.array([(i, degree - i) for degree in range(2, 6) for i in range(degree, -1, -1)][:terms])
    coefficients = np.array([ACROSS[:terms], UP[:terms]])

    def moved(x, y, size=1.0):
        u, v = x / half, y / half
        return size * np.tensordot(coefficients, np.array([u**i * v**j for i, j in powers]), 1)

    places = np.meshgrid(*2 * [np.linspace(-half, half, 65)])
    size = farthest * camera.pixel_size / np.hypot(*moved(*places)).max()
    numbers = size * coefficients / half ** powers.sum(1)
    return camera.replace(mla_warp=tuple(numbers.ravel())), lambda x, y: moved(x, y, size)


def colour_filters(camera, mosaic):
    """Return each pixel's channel: the letters of a mosaic's name, row by row from the detector's first pixel."""
    sides = zip(camera.crop_offset, camera.crop_size, strict=True)
    columns, rows = ((np.arange(count) + first) % 2 for first, count in sides)
    return np.array(["RGB".index(letter) for letter in mosaic]).reshape(2, 2)[np.ix_(rows, columns)]


WAVELENGTH = 633.0

LATTICES = {
    "hexagonal": {"mla_lattice": "hexagonal"},
    "turned": {"mla_rotation": 7.0, "mla_offset": (0.01, -0.02)},
    "circles": {"mla_lattice": "hexagonal", "mla_rotation": 11.0, "mla_aperture": "circle", "mla_fill": 0.95},
    "gaps": {"mla_fill": 0.8},
    "rectangular": {"mla_pitch": (0.064, 0.05)},
    "stretched": {"mla_lattice": "hexagonal", "mla_pitch": (0.056, 0.07), "mla_rotation": 4.0},
    "three focal lengths": {
        "mla_lattice": "hexagonal", "mla_focal_length": (0.44, 0.512, 0.6), "mla_offset": (0.013, 0.0)
    },
}  # fmt: skip
"""Microlens arrays beside the square one."""

OTHER = {"focal_length": 50, "aperture_radius": 4, "mla_distance": 70, "mla_focal_length": 0.4, "mla_pitch": 0.05}
"""A camera whose numbers are others than the paper's throughout."""

HALF = {"focal_length": 40, "aperture_radius": 2.5, "mla_distance": 60}
"""The paper's main lens at half its size: the same micro-images and angles, and fields of a quarter of the samples."""


def small_camera(lenses=8, **parameters):
    """Return the paper's camera with so many lenses across."""
    return PlenopticCamera(detector_width=0.064 * lenses, resolution=(32 * lenses,) * 2, **parameters)


def scattered(count, seed=0, distances=(225.0, 255.0), image=0.2):
    """Return scene points with their images anywhere within a distance from the axis."""
    rng = np.random.default_rng(seed)
    g = rng.uniform(*distances, count)
    return np.column_stack([rng.uniform(-image, image, (count, 2)) * -g[:, None] / 120.0, g])


def in_every_lens(camera, lenses, distance, per_lens=1, offset=0.0):
    """Return scene points at the same places of neighbouring lenses, by steps along the vectors of the lattice."""
    steps = (np.arange(lenses * per_lens) + 0.5) / per_lens - lenses / 2 + offset
    i, j = (index.ravel() for index in np.meshgrid(steps, steps))
    place = np.array(camera.lattice.centre(0.0, 0.0)) + np.stack([i, j], -1) @ np.array(camera.lattice.basis)
    return np.column_stack([place * -distance / camera.mla_distance, np.full(len(place), distance)])


def capture(camera, points, weights, *, wavelength=WAVELENGTH, job=None, **options):
    """Sum point spreads."""
    return CaptureOperator(camera, points, wavelength=wavelength, **options).forward(weights, job=job)


def pattern_count(operator, wavelength=WAVELENGTH):
    """Count the point spreads that an operator computes at a wavelength for its points."""
    return len(operator._plans.at(wavelength)._positions)


error = relative


def thin_as_real(camera, field, nearness):
    """Return the thin main lens of a camera, fitted over its pupil as a real one is."""
    thin = ThinLens(camera.focal_length, Pupil(camera.aperture_radius, camera.mla_distance), "parabolic")

    def rays(field, nearness, entrance):
        distance = 1 / nearness
        point = (np.zeros_like(field), field * distance, distance)
        pupil = tuple(entrance)
        path = thin.path(pupil, point, WAVELENGTH) * WAVELENGTH * 1e-6
        amplitude = thin.amplitude(pupil, point) * distance
        stops = (entrance**2).sum(0)[None] / thin.pupil.radius**2
        return PupilRays(field, nearness, entrance, entrance, path, amplitude, stops)

    pupils = Pupils(0.0, 1.0, 1 / camera.focal_length)
    fitted = fit_pupil(rays, pupils, camera.aperture_radius, field, nearness, WAVELENGTH, good=1e-8)
    assert fitted.error < 1e-7
    return FittedLens(thin, camera.aperture_radius, fitted)


TABLE = np.random.default_rng(3).uniform(0.2, 1.3, (6, 6))
UNEVEN = Vignetting(
    radius=[0.8, 0.1, -0.05, 0, 0.05, 0.1], ellipse_x=[0.05, 0.1, 0], ellipse_y=[0.1], slope_x=[0.2, 0.1, -0.3],
    slope_y=[-0.25], apodisation_2=[-0.3, 0, 0.2], apodisation_4=[0.1], scale=0.16, transmission=[0.1, -0.2, 0.05],
    harmonics=[0.05, -0.03, 0.0, 0.04],
)  # fmt: skip
CODE = np.pad(np.array([[1, 1, 0, 1, 0], [0, 1, 1, 0, 1], [1, 0, 0, 1, 1], [0.5, 1, 0, 0, 1], [1, 0, 1, 0.2, 0]]), 1)

THIN = {
    "square": {},
    **LATTICES,
    "focused": {"mla_distance": 56.0, "detector_distance": 0.6},
    "cropped": {
        "mla_rotation": -13.0, "mla_fill": 0.9, "detector_distance": 0.48,
        "crop_offset": (40, 30), "crop_size": (75, 51),
    },
    "parabolic": {"lens_model": "parabolic"},
    "medium": {"mla_medium": 1.5, "mla_focal_length": 0.768},
    "sphere": {"mla_shape": Conic(0.25), "mla_focal_length": None},
    "warped": {"mla_warp": warped(small_camera(4, **HALF), 1.5, 18)[0].mla_warp},
    "unequal lenses": {"mla_transmissions": TABLE},
    "aberrated": {"wavefront": (0.0, 0.1, 0.0, 0.3, -0.2)},
    "vignetted": {"vignetting": UNEVEN},
    "apodised": {"pupil_apodisation": (-0.6, 0.2)},
    "blades": {"aperture_blades": 6},
    "coded": {"aperture_image": CODE},
    "blurred": {"detector_blur": 0.003},
}  # fmt: skip
"""Cameras behind thin main lenses, by what differs from a camera of 4 x 4 lenses at half the paper's size."""

CAMERAS = {name: small_camera(4, **HALF | changes) for name, changes in THIN.items()} | {
    "ordinary": PlenopticCamera(
        mla_lattice="none", focal_length=40, aperture_radius=4, focus_distance=120, resolution=(40, 30),
        detector_width=0.08,
    ),
    "microscope": PlenopticCamera(
        main_lens=Objective(20, 0.5), mla_pitch=0.15, mla_focal_length=3.0, mla_offset=(0.075, 0.075),
        detector_width=0.75, resolution=(75, 75),
    ),
    "real": PlenopticCamera(
        main_lens="double_gauss", focal_length=40, aperture_radius=2.5, focus_distance=120, detector_width=0.256,
        resolution=(128, 128),
    ),
}  # fmt: skip
"""One small camera of each kind, of which the same is asked in `tests/physics`."""


def seen_by(name):
    """Return two points that a camera of `CAMERAS` sees, out of focus and beside the axis."""
    if name == "microscope":
        return np.array([(0.004, -0.003, 0.006), (-0.006, 0.002, -0.004)])
    return np.array([(0.05, -0.03, 115.0), (-0.06, 0.04, 124.0)])


def white(camera):
    """Return the scene of a sky of radiance 1 before a camera."""
    sky = {"type": "constant"}
    return mi.load_dict({"type": "scene", "i": {"type": "direct"}, "camera": camera.to_sensor(), "sky": sky})


def sky(camera, spp, model="ray", **options):
    """Return the image of a sky of radiance 1."""
    return render_capture(white(camera), spp=spp, model=model, **options).image
