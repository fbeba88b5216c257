"""Relations of what extensions compute, each with its draws; `NOT_DRAWN` says why an extension has none."""

import json

import numpy as np
import of_captures
from camera_draws import OPTIONS, scaled
from of_points import bound, picture
from relation import off, relation

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import choices, far_sources, laser, onchip, particles, wavefront
from mitsuba_plenoptic.camera.entry import Use
from mitsuba_plenoptic.dataset import make_sample, parse_recipe
from mitsuba_plenoptic.extensions.particles.scattering import ScatteredLight

DRAWN = ("data", "laser", "onchip", "particles", "raw", "wavefront")

NOT_DRAWN = {
    "calibrate": "its pictures of boards take seconds of rendering each; tests/extensions/calibrate renders them",
    "deconvolution": "a method of reconstruction: of_captures.py has its relations",
    "inverse": "its derivatives and adjoints are those of of_points.py",
    "lensdesign": "it reads prescriptions, and computes nothing of cameras",
    "paper": "it repeats one camera's figures",
    "prediction": "its formulas are of one camera each; tests/extensions/prediction compares them with captures",
    "sharpness": "it measures pictures, not cameras",
    "studio": "it shows what others compute",
}


def operator_of(camera, point, wavelength):
    return mp.CaptureOperator(camera, [point], wavelength=wavelength)


of_captures.USES |= {
    "laser": lambda c, p, w: laser.coherent_capture(operator_of(c, p, w), [1.0]),
    "slopes": lambda c, p, w: wavefront.view_slopes(c, picture(c, [p], w), p).slope,
    "stored": lambda c, p, w: mp.StoredOperator(c, [p], wavelength=w).forward([1.0]),
    "mosaic": lambda c, p, w: mp.demosaic(mp.Capture(np.ones(c.shape, np.float32), c), mosaic="RGGB"),
}


@relation(Use.POINTS, "crop_offset crop_size", "particles")
def medium_of_particles(draw):
    """Particles in a fluid scatter as in air at its wavelength, if their index is that over the fluid's."""
    medium, index = float(draw.rng.uniform(1.2, 1.6)), complex(draw.rng.uniform(1.7, 2.0), 0.01)
    if draw.camera.objective is not None:
        return None
    positions, diameters = np.array([draw.point() for _ in range(3)]), draw.rng.uniform(0.3, 5.0, 3)
    in_fluid, in_air = (
        ScatteredLight(
            draw.camera,
            positions,
            diameters,
            np.ones(3),
            (0.6, 0.0, 0.8),
            particles.Seeding(count=3, index=index / n, medium=medium / n),
            particles.Window(),
            draw.wavelength / n,
        ).powers
        for n in (1.0, medium)
    )
    return off(in_fluid, in_air), 1e-6


@relation(Use.POINTS, "glass mla_glass crop_offset crop_size", "particles")
def units_of_particles(draw):
    """All lengths twice as long: the same capture of particles, whose cross-sections are four times as large."""
    if draw.camera.lens_data.traced_surfaces or draw.camera.objective is not None or not draw.camera.has_array:
        return None
    g, reach = draw.point()[2], 1.5 * draw.camera.mla_pitches[0]
    images, references = [], []
    for s in (1.0, 2.0):
        camera = mp.PlenopticCamera(**scaled(draw.parameters, s))
        box = particles.ParticleVolume(*(tuple(s * np.array([k * reach, k * reach, g + k])) for k in (-1.0, 1.0)))
        seeding = particles.Seeding(count=8.0, diameter=2.0 * s)
        truth = particles.particle_sequence(
            camera, box, seeding, particles.Uniform((0.0, 0.0, 0.0)), interval=1.0, seed=draw.seed % 1000
        )
        capture = particles.ParticleImages(truth, wavelength=s * 400.0).capture(0)
        images.append(capture.image)
        references.append(float(capture.metadata["reference"]))
    return max(off(images[1], images[0]), abs(references[1] / references[0] / 4 - 1)), 5e-3


@relation(Use.POINT_FIELDS | Use.COHERENT_POINTS | Use.POINTS, "crop_offset crop_size", "laser light")
def single_laser_point(draw):
    """A capture of one coherent point is that of an incoherent one, on detectors that hold more than its wings."""
    point = draw.point()
    operator = mp.CaptureOperator(draw.camera, [point], wavelength=draw.wavelength, accuracy=0.0)
    return off(laser.coherent_capture(operator, [1.0], modes=1, seed=2), operator.forward([1.0])), bound(draw, 0.01)


@relation(Use.POINTS | Use.LENS_CENTRES, "stray_light stray_width", "wavefronts")
def slopes_of_wavefronts(draw):
    """Slopes in views of a camera twice as large are the same, at pupil points twice as far apart."""
    x, y, g = draw.point()
    image = picture(draw.camera, [(x, y, g)], draw.wavelength)
    larger = mp.PlenopticCamera(**scaled(draw.parameters, 2.0))
    one = wavefront.view_slopes(draw.camera, image, (x, y, g))
    two = wavefront.view_slopes(larger, image, (2 * x, 2 * y, 2 * g))
    return max(off(two.pupil / 2, one.pupil), off(two.slope, one.slope)), 1e-6


@relation(Use(0), " ".join(OPTIONS), "far sources")
def twin_stars(draw):
    """Two stars on one place are one star of their light, whatever the camera."""
    direction = tuple(draw.rng.uniform(-60, 60, 2).tolist())
    points, weights = far_sources.binary(0.0, ratio=0.5, direction=direction)
    star, weight = far_sources.star(direction, weight=1.0)
    return max(off(points[0], star[0]), off(points[1], star[0]), abs(weights.sum() / weight.sum() - 1)), 1e-12


@relation(Use(0), " ".join(OPTIONS), "dual pixels")
def halves(draw):
    """Pictures of halves add up to that of whole lenses, and a mirrored capture exchanges them; of one camera."""
    camera = mp.PlenopticCamera(detector_width=0.0512, resolution=(16, 16), mla_pitch=0.0064, mla_distance=60.0)
    image = draw.rng.random((16, 16), np.float32)
    captures = (mp.Capture(each, camera) for each in (image, image[:, ::-1].copy()))
    plain, mirrored = (onchip.dual_pixel(each).values for each in captures)
    whole = image.reshape(8, 2, 8, 2).sum((1, 3))
    return max(off(plain[0].sum(0), whole), off(mirrored[0, 0], plain[0, 1][:, ::-1])), 1e-6


@relation(
    Use.RAYS,
    "main_lens mla_shape vignetting mla_transmissions phase_screen aperture_image glass mla_glass",
    "data sets",
)
def samples(draw):
    """A sample of a data set is the same however often it is made."""
    content = {
        "name": "relation",
        "count": 3,
        "seed": draw.seed,
        "models": ["ray"],
        "camera": json.loads(draw.camera.to_json()),
        "scenes": [{"generator": "shapes", "objects": {"from": 3, "to": 6, "step": 1}}],
        "ray": {"spp": 1},
    }
    number = int(draw.rng.integers(3))
    one, two = (make_sample(parse_recipe(content), number) for _ in range(2))
    return off(one.arrays["ray"], two.arrays["ray"]), 0.0


@relation(Use(0), method="mosaics of colours")
def grey_mosaic(draw):
    """An even grey through a mosaic of filters is grey again, by plain interpolation."""
    mosaic, level = str(draw.rng.choice(choices.MOSAICS)), float(draw.rng.uniform(0.2, 1.0))
    grey = mp.Capture(np.full(draw.camera.shape, level, np.float32), draw.camera)
    colours = mp.demosaic(grey, mosaic=mosaic, method="plain")
    return float(np.abs(colours.image - level).max()), 1e-5
