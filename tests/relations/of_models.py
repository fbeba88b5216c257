"""Relations of parts and their sum, of a quarter turn, of limits, and of models of light against each other."""

import pickle
import tempfile
from contextlib import contextmanager
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from camera_draws import LENSES, OPTIONS, on_stage
from of_captures import sky, wall
from of_points import IRREGULAR, bound, picture
from relation import off, relation

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.camera import PARAMETERS, is_supported
from mitsuba_plenoptic.camera.entry import Use
from mitsuba_plenoptic.runtime import Job, Threads

CROPS = "crop_offset crop_size"


@relation(Use.POINTS)
def sum_of_lamps(draw):
    """The picture of two lamps is the sum of their pictures, within the error of a patch."""
    points, weights = [draw.point(), draw.point()], draw.rng.uniform(0.2, 2.0, 2)
    one, two = (picture(draw.camera, [point], draw.wavelength) for point in points)
    both = picture(draw.camera, points, draw.wavelength, weights)
    return off(both, weights[0] * one + weights[1] * two), bound(draw, 0.005)


@relation(Use.POINTS)
def channels_of_lamps(draw):
    """Channels of single wavelengths are the pictures at each of them."""
    points, wavelengths = [draw.point()], (500.0, 620.0)
    operator = mp.CaptureOperator(draw.camera, points, spectrum=mp.Spectrum.lines(*wavelengths), accuracy=0.0)
    image = np.asarray(operator.forward(np.ones((1, 2))), float)
    return max(off(image[..., i], picture(draw.camera, points, w)) for i, w in enumerate(wavelengths)), 1e-5


class StoppedError(Exception):
    """Stands in for the end of a process."""


@relation(Use.POINTS, method="checkpoints")
def resumed(draw):
    """A sum that was stopped and goes on from its checkpoint: the same picture."""
    operator = mp.CaptureOperator(draw.camera, [draw.point() for _ in range(3)], wavelength=draw.wavelength)

    def stop(done, total):
        if done > 0:
            raise StoppedError

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sum.checkpoint"
        try:
            with mp.Checkpoint(path) as checkpoint:
                operator.forward(np.ones(3), job=Job(progress=stop, keeper=checkpoint))
        except StoppedError:
            pass
        with mp.Checkpoint(path, "resume_if_same") as checkpoint:
            image = operator.forward(np.ones(3), job=Job(keeper=checkpoint))
    return off(image, operator.forward(np.ones(3))), 0.0


@relation(Use.POINTS, f"{CROPS} stray_light stray_width")
def larger_detector(draw):
    """A detector of more pixels records the same in the middle, but for what blur brings across the rim."""
    camera, points, more = draw.camera, [draw.point()], int(draw.rng.integers(3, 12))
    small = picture(camera, points, draw.wavelength)
    count = camera.resolution[0]
    pixels = count + 2 * more
    width, size = camera.detector_width * pixels / count, (pixels,) * 2
    larger = camera.replace(detector_width=width, resolution=size, crop_size=size)
    whole = picture(larger, points, draw.wavelength)
    rim = 8 if {"detector_blur", "pixel_crosstalk"} & set(draw.options) else 0
    inner = np.s_[rim : count - rim, rim : count - rim]
    return off(whole[more:-more, more:-more][inner], small[inner]), 2 * bound(draw, 2.5e-3)


@relation(Use.POINTS, f"{IRREGULAR} {CROPS} wavefront vignetting mla_warp main_lens mla_cra")
def quarter_turn(draw):
    """Camera and point turned by 90 degrees: the turned picture."""
    x, y, g = draw.point()
    p = dict(draw.parameters)
    if draw.camera.has_array:
        p["mla_rotation"] = draw.camera.mla_rotation + 90.0
    if "mla_offset" in p:
        p["mla_offset"] = (-p["mla_offset"][1], p["mla_offset"][0])
    if "aperture_blades" in p:
        p["aperture_blades"] = (p["aperture_blades"][0], p["aperture_blades"][1] + 90.0)
    if "aperture_image" in p:
        p["aperture_image"] = mp.Aperture(np.rot90(p["aperture_image"].transmission, -1))
    if isinstance(p.get("stray_light"), mp.StrayLight):
        p["stray_light"] = mp.StrayLight(np.rot90(p["stray_light"].values, -1))
    turned = picture(mp.PlenopticCamera(**p), [(-y, x, g)], draw.wavelength)
    return off(turned, np.rot90(picture(draw.camera, [(x, y, g)], draw.wavelength), -1)), bound(draw, 2e-3)


@relation(Use.RAYS, method="captures by rays")
def moved_together(draw):
    """Scene and camera moved and turned together: the same capture by the same rays."""
    g, place = draw.point()[2], mi.ScalarTransform4f().translate([1.0, -2.0, 3.0]).rotate([0.6, 0.0, 0.8], 40.0)
    one, two = (
        mp.render_capture(wall(draw.camera, g, moved=each), model="ray", spp=4).image
        for each in (mi.ScalarTransform4f(), place)
    )
    # Rounding sends a few rays over an edge of the texture.
    return off(two, one), 0.03


VANISHING = {
    "mla_offset": (1e-8, 0.0),
    "mla_rotation": 1e-6,
    "mla_tilt": (1e-6, 0.0),
    "mla_fill": 1 - 1e-6,
    "mla_medium": 1 + 1e-7,
    "mla_absorption": 1e-7,
    "mla_jitter": (1e-9, 0.0),
    "mla_figure_error": (1e-10, 0.05),
    "mla_warp": (1e-9,) * 14,
    "distortion": (1e-9, 0.0, 0.0, 0.0, 0.0),
    "wavefront": (0.0, 0.0, 0.0, 1e-7),
    "pupil_apodisation": (1e-7, 0.0),
    "detector_blur": 1e-6,
    "pixel_crosstalk": 1e-7,
    "pixel_response": (0.0, 1.0, 80.0, 1.0),
    "vignetting": mp.Vignetting([2.0]),
    "stray_light": 1e-7,
    "glass": {"index": 1.5, "abbe": 1e7},
    "mla_glass": {"index": 1.5, "abbe": 1e7},
}
"""Values next to those at which parameters have no effect: gaps, dispersion, aberrations and blur vanish."""


def without_effect(draw, use, image):
    """Judge that a value next to none changes a capture by no more than models do, of a parameter that is not drawn."""
    allowed = [
        name
        for name in sorted(set(VANISHING) - set(draw.parameters))
        if draw.camera.has_array or not name.startswith("mla_")
    ]
    other = draw.camera.replace(**{name: VANISHING[name] for name in [str(draw.rng.choice(allowed))]})
    return (off(image(other), image(draw.camera)), 5e-3) if is_supported(other, use) else None


@relation(Use.POINTS)
def vanishing(draw):
    """Gaps, dispersion, aberrations and blur next to none have next to no effect in captures of points."""
    points = [draw.point()]
    return without_effect(draw, Use.POINTS, lambda camera: picture(camera, points, draw.wavelength))


@relation(Use.RAYS)
def vanishing_for_rays(draw):
    """They have next to none in captures by the same rays, either."""
    g = draw.point()[2]
    return without_effect(draw, Use.RAYS, lambda camera: mp.render_capture(wall(camera, g), model="ray", spp=4).image)


@relation(Use.WHITE_IMAGES)
def vanishing_in_white(draw):
    """They have next to none in white images, though other methods compute these.

    Pictures in the aperture have steps, which rays sample.
    """
    judgement = without_effect(draw, Use.WHITE_IMAGES, mp.views.white_image)
    return judgement and (judgement[0], 0.02 if "aperture_image" in draw.options else judgement[1])


@relation(Use.POINTS, f"mla_medium mla_absorption mla_shape mla_glass mla_cra pixel_response {CROPS}")
def medium(draw):
    """A medium behind the lenses is paraxially air whose lengths are those of the medium over its index.

    Aberrations of the shorter lenses differ: by up to 7 per cent of a picture at an index of 1.5, less in proportion.
    """
    camera, points, n = draw.camera, [draw.point()], 1.02
    if not camera.has_array:
        return None
    lengths = np.array(camera.mla_focal_lengths) / n
    air = camera.replace(mla_focal_length=tuple(lengths.tolist()), detector_distance=camera.detector_distance / n)
    return off(*(picture(each, points, draw.wavelength) for each in (camera.replace(mla_medium=n), air))), 0.008


@relation(Use.POINTS | Use.FULL_FIELDS, f"main_lens {CROPS}", "full fields")
def full_fields(draw):
    """Point spreads on the lit lenses are those on the whole array, within what their page states."""
    of, at = (draw.camera, draw.point()), {"wavelength": draw.wavelength}
    one, two = (mp.point_spread_function(*of, **at, method=each) for each in ("patch", "full_field"))
    return off(one, two), bound(draw, 0.008)


@relation(Use.POINTS | Use.RAY_SPREADS, f"main_lens {CROPS}", "point spreads by rays")
def short_waves(draw):
    """Short waves have the light of rays, and come nearer to their picture than long ones."""
    camera, point = draw.camera, draw.point()
    rays = mp.point_spread_function(camera, point, model="ray", wavelength=draw.wavelength).astype(float)
    long, short = (picture(camera.at_wavelength(draw.wavelength), [point], w) for w in (700.0, 200.0))
    if rays.sum() < 0.1:
        return None
    light = abs(short.sum() / rays.sum() - 1) / (0.06 if "mla_fill" in draw.options else 0.03)
    return max(light, off(short, rays) / (off(long, rays) + bound(draw, 0.005))), 1.0


@relation(
    Use.POINTS | Use.RAY_SPREADS,
    " ".join(["crop_offset crop_size detector_blur", *on_stage(OPTIONS, "array")]),
    "ordinary cameras",
    lambda seed: on_stage(OPTIONS, "pupil"),
)
def contrast_without_array(draw):
    """The longest waves of a picture out of focus have the contrast and place of rays in the limit of short waves."""
    ordinary = {name: value for name, value in draw.parameters.items() if not PARAMETERS[name].of_array}
    if draw.camera.objective is not None:
        return None
    camera, (x, y, _) = mp.PlenopticCamera(**ordinary | {"mla_lattice": "none"}), draw.point()
    camera, point = camera.at_wavelength(draw.wavelength), (x, y, camera.focus_distance * draw.rng.uniform(1.05, 1.1))
    rays = mp.point_spread_function(camera, point, model="ray", wavelength=draw.wavelength).astype(float)
    # What diffraction adds is proportional to the wavelength, with which glasses of prescriptions change, too.
    wavelengths = [draw.wavelength] * 2 if camera.prescription else [200.0, 400.0]
    short, long = (picture(camera, [point], wavelength) for wavelength in wavelengths)
    one, other = (np.fft.fft2(image)[:2, :2] for image in (2 * short - long, rays))
    limit = 0.05 if {"aperture_image", "main_lens"} & set(draw.options) else 0.02
    return float(np.abs(one - other).max()), limit


class Elsewhere:
    """Computes batches from their pickled copies, as other processes do."""

    workers = threads = 1

    def __call__(self, batches):
        for batch in batches:
            yield pickle.loads(pickle.dumps(batch)).prepare()()


@relation(Use.POINTS, method="workers")
def workers_of_points(draw):
    """A sum of points has the same bits on one thread, on several, and where batches are sent to."""
    operator = mp.CaptureOperator(draw.camera, [draw.point() for _ in range(3)], wavelength=draw.wavelength)
    ways = Threads(1), Threads(3), Elsewhere()
    one, *others = (operator.forward(np.ones(3), job=Job(batch_map=each)) for each in ways)
    return float(not all(np.array_equal(each, one) for each in others)), 0.0


@contextmanager
def on_threads(count):
    """Let Dr.Jit have so many threads; Mitsuba writes no OpenEXR where one is left of several."""
    before = dr.thread_count()
    dr.set_thread_count(count)
    try:
        yield
    finally:
        dr.set_thread_count(before)


@relation(Use.SCENES, method="workers")
def workers_of_scenes(draw):
    """A wave capture of a scene has the same bits, too, also on several threads of Dr.Jit."""
    scene, images = wall(draw.camera, draw.point()[2]), []
    for count, each in ((1, Threads(1)), (3, Threads(3)), (1, Elsewhere())):
        with on_threads(count):
            options = {"wavelength": draw.wavelength, "batch_map": each}
            images.append(mp.render_capture(scene, model="wave", spp=4, **options).image)
    return float(not all(np.array_equal(each, images[0]) for each in images[1:])), 0.0


@relation(Use.RAYS, method="workers")
def threads_of_rays(draw):
    """A ray capture has the same bits on one thread and on several, but for what blur leaves of numbers near none."""
    scene, images = wall(draw.camera, draw.point()[2]), []
    for count in (1, 3):
        with on_threads(count):
            images.append(mp.render_capture(scene, model="ray", spp=4).image)
    return float(np.abs(images[0] - images[1]).max()), 1e-36


@relation(
    Use.RAYS | Use.SCENES,
    "mla_cra pixel_response wavefront phase_screen mla_warp crop_offset crop_size main_lens",
    "captures by waves",
    lambda seed: ["mla_absorption", "mla_medium", "mla_tilt"],
)
def wide_array(draw):
    """Forty lenses across, of few pixels, have the light of a white world by waves as by rays."""
    lens = int(draw.rng.integers(3, 5))
    width = draw.camera.detector_width * 40 / LENSES
    camera = draw.camera.replace(detector_width=width, resolution=(40 * lens,) * 2, crop_size=(40 * lens,) * 2)
    scene = sky(camera)
    waves = mp.render_capture(scene, model="wave", spp=64, wavelength=draw.wavelength, noise=True)
    rays = mp.render_capture(scene, model="ray", spp=256)
    noise = float(np.linalg.norm(waves.noise) / waves.image.sum())
    return abs(float(waves.image.mean() / rays.image.mean()) - 1), 0.002 + 3 * noise
