"""Relations of captures of scenes and of reconstructions: units, mirror, planes, channels, white, files."""

import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np
from camera_draws import LENSES, OPTIONS, Draw, on_stage, scaled
from cases import film
from of_points import AT_THE_LINE_D, IRREGULAR, bound, mirrored_options
from relation import off, relation
from scipy.ndimage import correlate1d

import mitsuba_plenoptic as mp
import mitsuba_plenoptic.refocus
from mitsuba_plenoptic import views
from mitsuba_plenoptic.camera.entry import Use
from mitsuba_plenoptic.views import lens_numbers, white_image

METHODS = {
    "ray": Use.RAY_REFOCUSING,
    "coherent": Use.FIELDS,
    "partial": Use.FIELDS,
    "incoherent": Use.RESPONSES,
    "deconvolved": Use.RESPONSES,
}


def image_at(camera, image, distance, method, wavelength, **others):
    """Return the image refocused from pixels at one distance, or images at several."""
    options = others if method == "ray" or others else {"wavelength": wavelength}
    options |= {"iterations": 2} if method == "deconvolved" else {}
    result = mp.reconstruct(image, distance, camera=camera, method=method, **options)
    return [each.image for each in result] if isinstance(result, list) else np.squeeze(result.image)


def of_reconstructions(method):
    """Add the relations of one method of reconstruction."""
    use, rng_image = METHODS[method], lambda draw: draw.rng.random(draw.camera.shape, np.float32)

    def units(draw):
        """All lengths and the wavelength twice as long: the same refocused image."""
        if draw.camera.prescription is not None and method != "ray":
            return None
        image, g = rng_image(draw), draw.point()[2]
        other = image_at(mp.PlenopticCamera(**scaled(draw.parameters, 2.0)), image, 2 * g, method, 2 * draw.wavelength)
        return off_bins(other, image_at(draw.camera, image, g, method, draw.wavelength)), 1e-3

    def mirror(draw):
        """Mirrored capture of the mirrored camera: the mirrored image."""
        if draw.camera.has_array and "mla_offset" not in draw.options:
            # Middles of pixels lie on no border between lenses, where both might own them.
            draw = Draw(draw.seed, [*draw.options, "mla_offset"])
        image, g = rng_image(draw), draw.point()[2]
        other = mp.PlenopticCamera(**mirrored_options(draw))
        there = image_at(other, np.ascontiguousarray(image[:, ::-1]), g, method, draw.wavelength)
        limit = {"ray": bound(draw, 0.005), "coherent": 1e-4, "partial": 1e-4}.get(method, 0.004)
        return off_bins(there[:, ::-1], image_at(draw.camera, image, g, method, draw.wavelength)), limit

    def planes(draw):
        """Several distances at once are those of each alone, but for the samples of fields, which suit all of them."""
        image, distances = rng_image(draw), [draw.point()[2], draw.point()[2]]
        together = image_at(draw.camera, image, distances, method, draw.wavelength)
        alone = [image_at(draw.camera, image, g, method, draw.wavelength) for g in distances]
        return max(off_bins(*pair) for pair in zip(together, alone, strict=True)), 0.01 if use is Use.FIELDS else 1e-5

    def channels(draw):
        """Equal channels of colour are those of luminance."""
        image, g = rng_image(draw), draw.point()[2]
        colours = image_at(draw.camera, np.repeat(image[..., None], 3, 2), g, method, draw.wavelength)
        mono = image_at(draw.camera, image, g, method, draw.wavelength)
        return max(off_bins(colours[..., i], mono) for i in range(3)), 1e-4

    def white(draw):
        """A white world reads 1 over the middle of the image, by responses of its own model."""
        by_waves = use is Use.RESPONSES and draw.rng.random() < 0.5
        recorded = {"model": "wave", "wavelength": draw.wavelength} if by_waves else {"model": "ray"}
        capture = mp.render_capture(sky(draw.camera), spp=64, **recorded)
        others = {"response": "wave" if by_waves else "ray"} if method == "deconvolved" else {}
        g = 0.96 * draw.camera.focus_distance
        image = image_at(None, capture, g, method, draw.wavelength, **others)
        rows, columns = (count // 4 for count in image.shape)
        return abs(float(np.nanmean(image[rows:-rows, columns:-columns])) - 1), 0.02

    crops, costly = "crop_offset crop_size", "vignetting mla_focal_length" if use is Use.RESPONSES else ""
    for judge, without in (
        (units, AT_THE_LINE_D),
        (mirror, f"{IRREGULAR} {crops} vignetting"),
        (planes, ""),
        (channels, ""),
        (white, f"{crops} main_lens mla_focal_length"),
    ):
        judge.__name__ = f"{judge.__name__}_{method}"
        relation(use, f"{without} {costly}", method)(judge)


def off_bins(image, reference):
    """Return the relative difference over the bins that light reaches, which must be the same; or infinity."""
    empty = np.isnan(reference)
    if image.shape != reference.shape or np.any(np.isnan(image) != empty) or empty.all():
        return np.inf
    return off(image[~empty], reference[~empty])


def sky(camera):
    """Return the scene of a sky of radiance 1."""
    light = {"type": "constant"}
    return mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": camera.to_sensor(), "light": light})


for each in METHODS:
    of_reconstructions(each)


def wall(camera, g, moved=None, smooth=False):
    """Return the scene of a textured wall at a distance, which may be moved together with the camera."""
    texture = np.random.default_rng(5).random((8, 8, 1), np.float32)
    filtered = "bilinear" if smooth else "nearest"
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(texture), "filter_type": filtered, "raw": True}
    field = (
        camera.bin_count[0] * camera.bin_size(g)
        if camera.has_array
        else camera.detector_width * g / camera.mla_distance
    )
    width = (1.5 if smooth else 0.6) * field
    moved = moved or mi.ScalarTransform4f()
    place = moved.translate([0, 0, g]).rotate([0, 1, 0], 180).scale([width, width, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path"},
            "sensor": camera.to_sensor(moved),
            "wall": {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": radiance}},
        }
    )


def of_scenes(model, use):
    """Add the relations of captures of scenes by one model of light."""
    options = (lambda wavelength: {"wavelength": wavelength}) if model == "wave" else (lambda wavelength: {})

    def units(draw):
        """Lengths and the wavelength twice as long: the same capture by the same rays; catalogues have units."""
        if draw.camera.prescription is not None and model == "wave":
            return None
        g = draw.point()[2]
        other = mp.PlenopticCamera(**scaled(draw.parameters, 2.0))
        two, one = (
            mp.render_capture(wall(camera, s * g), model=model, spp=4, **options(s * draw.wavelength)).image
            for camera, s in ((other, 2.0), (draw.camera, 1.0))
        )
        return off(two, one), 0.01

    def seeds(draw):
        """Two seeds agree within the noise that captures state."""
        scene = wall(draw.camera, draw.point()[2])
        one, two = (
            mp.render_capture(scene, model=model, spp=16, seed=seed, noise=True, **options(draw.wavelength))
            for seed in (1, 2)
        )
        stated = np.sqrt((np.asarray(one.noise, float) ** 2 + np.asarray(two.noise, float) ** 2).sum())
        ratio = float(np.linalg.norm(one.image - two.image) / stated)
        return max(ratio, 1 / ratio), 1.15

    def channels(draw):
        """A grey wall in equal channels of colour is that in luminance, by the same rays."""
        g, images = draw.point()[2], []
        try:
            for variant, count in (("mono", 1), ("rgb", 3)):
                mi.set_variant(f"llvm_ad_{variant}")
                wavelengths = options(",".join([str(draw.wavelength)] * count))
                images.append(mp.render_capture(wall(draw.camera, g), model=model, spp=4, **wavelengths).image)
        finally:
            mi.set_variant("llvm_ad_mono")
        return max(off(images[1][..., i], images[0]) for i in range(3)), 1e-5

    # Waves choose rays by wavelengths and heights of lenses, whose rounding tells some of them apart.
    rounded = "mla_tilt" if model == "wave" else ""
    # Rays through glass, of real lenses, too, have a wavelength each, of one channel.
    dispersed = "glass mla_glass main_lens" if model == "ray" else ""
    for judge, without in (
        (units, f"{AT_THE_LINE_D} mla_jitter mla_seed {rounded}"),
        (seeds, ""),
        (channels, dispersed),
    ):
        judge.__name__ = f"{judge.__name__}_of_scenes_by_{model}s"
        relation(use, without, f"captures by {model}s")(judge)


of_scenes("ray", Use.RAYS)
of_scenes("wave", Use.SCENES)


@relation(Use.SCENES, "mla_cra pixel_response mla_absorption crop_offset crop_size", "captures by waves")
def white_of_scenes(draw):
    """A white world is as bright by waves as by rays, whatever pixels are beside the diffraction."""
    scene = sky(mp.PlenopticCamera(**scaled(draw.parameters, float(draw.rng.choice([1, 6, 40])))))
    waves = mp.render_capture(scene, model="wave", spp=256, wavelength=draw.wavelength).image.mean()
    return abs(float(waves / mp.render_capture(scene, model="ray", spp=64).image.mean()) - 1), 0.006


@relation(Use.RAYS | Use.WHITE_IMAGES)
def white_capture(draw):
    """A white world is recorded as the white image states, over lenses and over rings of their micro-images."""
    capture = mp.render_capture(sky(draw.camera), model="ray", spp=256).image
    white = white_image(draw.camera)
    numbers = lens_numbers(draw.camera).ravel() if draw.camera.has_array else np.zeros(white.size, int)
    numbers = 4 * numbers + np.digitize(white.ravel(), np.quantile(white, [0.3, 0.6, 0.8]))
    recorded, stated = (np.bincount(numbers, image.ravel()) for image in (capture, white))
    return off(recorded, stated), 0.02


@relation(Use.RAYS, method="files")
def files(draw):
    """Captures, cameras and sensors that are written and read are the same."""
    camera = draw.camera
    capture = mp.Capture(draw.rng.random(camera.shape, np.float32), camera)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        mp.write_capture(path / "raw.exr", capture)
        (path / "camera.json").write_text(camera.to_json())
        read = mp.read_capture(path / "raw.exr")
        cameras = [read.camera, mp.PlenopticCamera.from_json(camera.to_json())]
        cameras.append(mi.load_dict(camera.to_sensor()).camera)
        same = all(each.to_dict() == camera.to_dict() for each in cameras)
        return float(not same or not np.array_equal(read.image, capture.image)), 0.0


@relation(
    Use.RESPONSES | Use.WHITE_IMAGES,
    "main_lens mla_focal_length mla_rotation crop_offset crop_size",
    "incoherent",
    lambda seed: on_stage(OPTIONS, "pupil"),
)
def light_of_lenses(draw):
    """An even plane lights lenses off the axis as a white world does, but for what lenses diffract to others."""
    count = draw.camera.resolution[0]
    lens = count // LENSES
    camera = draw.camera.replace(crop_offset=(count - 4 * lens, count // 2 - lens), crop_size=(4 * lens, 3 * lens))
    from mitsuba_plenoptic.extensions.deconvolution.response import Response

    response = Response(camera, [0.96 * camera.focus_distance], wavelength=draw.wavelength, oversample=1)
    numbers = lens_numbers(camera).ravel()
    whole = np.bincount(numbers) > 0.8 * lens**2
    if not whole.any():
        return None
    even, white = (
        np.bincount(numbers, image.ravel())[whole]
        for image in (response.forward(np.ones(response.source_shape, np.float32)), white_image(camera))
    )
    return float(
        np.abs(even / white - 1).max()
    ), 0.07  # pixels on the borders of displaced lenses count for one of them


USES = {
    "rays": lambda c, p, w: mp.render_capture(wall(c, p[2]), model="ray", spp=1).image,
    "waves": lambda c, p, w: mp.render_capture(wall(c, p[2]), model="wave", spp=1, wavelength=w).image,
    "spread by rays": lambda c, p, w: mp.point_spread_function(c, p, model="ray"),
    "spread": lambda c, p, w: mp.point_spread_function(c, p, wavelength=w),
    "full field": lambda c, p, w: mp.point_spread_function(c, p, wavelength=w, method="full_field"),
    "gradient": lambda c, p, w: mp.CaptureOperator(c, [p], wavelength=w).gradient([1.0], np.ones(c.shape))["mla_pitch"],
    "field": lambda c, p, w: mp.CaptureOperator(c, [p], wavelength=w).field([1.0]).power,
    "decode": lambda c, p, w: mp.decode(np.ones(c.shape, np.float32), camera=c).values,
    "views": lambda c, p, w: views.view(mp.decode(np.ones(c.shape, np.float32), camera=c), u=0.1, v=-0.2),
    "views refocused": lambda c, p, w: views.refocus(mp.decode(np.ones(c.shape, np.float32), camera=c), p[2]),
    "micro-images": lambda c, p, w: views.micro_images(mp.Capture(np.ones(c.shape, np.float32), c)).values,
    "truth": lambda c, p, w: mp.ground_truth(wall(c, p[2]), ["shape_index"]).pixels["shape_index"],
    "exposure": lambda c, p, w: mp.expose(mp.Capture(np.ones(c.shape, np.float32), c), photons=50.0).image,
    **{name: (lambda c, p, w, name=name: image_at(c, np.ones(c.shape, np.float32), p[2], name, w)) for name in METHODS},
}
"""Computations that any camera may be asked for."""


@relation(Use(0), method="refusals")
def refusals(draw):
    """Every draw is computed, or refused in one line that names an option; bins without light alone are NaN."""
    name = str(draw.rng.choice(sorted(USES)))
    result = np.asarray(USES[name](draw.camera, draw.point(), draw.wavelength), float)
    finite = np.isfinite(result)
    return float(
        not (
            finite | (np.isnan(result) & (name in (*METHODS, "decode", "views", "views refocused", "micro-images")))
        ).all()
        or not finite.any()
    ), 0.0


@relation(Use.DECODING, "mla_shape mla_figure_error", "light fields")  # of rays that take long
def brightness(draw):
    """Brighter captures have brighter views of the same weight, and dimmer lenses or pupils change no weight."""
    image = draw.rng.random(draw.camera.shape, np.float32)
    even = draw.camera.replace(mla_transmissions=None, pupil_apodisation=(0.0, 0.0))
    one, other, plain = (
        mp.decode(values, camera=camera)
        for values, camera in ((image, draw.camera), (3 * image, draw.camera), (image, even))
    )
    weights = max(off(each["weight"], one["weight"]) for each in (other, plain))
    return max(off_bins(other.values, 3 * one.values), weights), 1e-5


MOVING = "main_lens mla_shape mla_figure_error phase_screen distortion aperture_image detector_distance"
"""What bends the rays of views, or moves them within a pixel's square of the pupil, but for aberrations."""


def seen_through(lf, camera, scene, u, v):
    """Return what a pinhole at a point of the pupil sees of a scene, in the bins of a light field's views."""
    width, height = np.array(camera.bin_count) * abs(float(lf.s[1] - lf.s[0]))
    pinhole = {
        "type": "perspective",
        "fov": 2 * np.degrees(np.arctan(width / 2 / camera.focus_distance)),
        "principal_point_offset_x": u / width,
        "principal_point_offset_y": v / height,
        "to_world": mi.ScalarTransform4f().translate([u, v, 0]),
        "film": film(*camera.bin_count),
    }
    return np.array(mi.render(scene, sensor=mi.load_dict(pinhole), spp=64), float)[..., 0]


@relation(Use.DECODING | Use.RAYS, f"{MOVING} lens_model wavefront crop_offset crop_size detector_blur", "light fields")
def views_of_pinholes(draw):
    """A view of a smooth wall is what a pinhole at its point of the pupil sees, within a tenth of a bin."""
    camera, g = draw.camera, draw.point(0.4)[2]
    scene = wall(camera, g, smooth=True)
    lf = mp.decode(mp.render_capture(scene, model="ray", spp=256))
    u, v = (float(draw.rng.uniform(-0.4, 0.4)) * camera.aperture_radius for _ in "uv")
    view = views.view(lf, u=u, v=v)
    expected = seen_through(lf, camera, scene, float(view.u), float(view.v))
    inner = np.s_[1:-1, 1:-1]
    blurs = (correlate1d(expected, [1, -2, 1], axis) for axis in (0, 1))
    terms = np.stack([each[inner].ravel() for each in (expected, *np.gradient(expected), *blurs)], -1)
    bright, *others = np.linalg.lstsq(terms, view.values[inner].ravel(), rcond=None)[0]
    return float(np.hypot(*others[:2]) / bright), 0.1


UNEVEN = "mla_transmissions vignetting pupil_apodisation mla_absorption pixel_response"
"""What makes lenses or places of the pupil unequally bright, in a picture and in its white alike."""


@relation(
    Use.DECODING | Use.RAYS,
    f"{MOVING.replace('distortion', '')} crop_offset crop_size mla_rotation mla_warp",
    "depth",
    lambda seed: [*UNEVEN.split(), "mla_tilt", "lens_model", "wavefront", "distortion", "detector_blur", "glass"],
)
def depth_of_walls(draw):
    """A wall is where it is, far from focus, too, whatever dims its light (in picture and white) or mixes it."""
    camera, model = draw.camera, "wave" if draw.rng.random() < 0.5 and "aperture_blades" not in draw.options else "ray"
    camera = camera.replace(detector_width=2 * camera.detector_width, resolution=(2 * camera.resolution[0],) * 2)
    b, most = camera.mla_distance, min(5 * camera.row_pitch / camera.pupil_radius, 0.1)
    g = b / (b / camera.focus_distance + most * float(draw.rng.uniform(-1, 1)))
    capture = mp.render_capture(wall(camera, g), model=model, spp=64)
    fall = 1 + 0.7 * np.sin(np.arange(camera.crop_size[0]) / 9, dtype=np.float32)
    picture, white = (np.float32(image * fall) for image in (capture.image, white_image(camera)))
    ways = mp.decode(capture), *([mp.decode(picture, camera=camera, white=white)] if model == "ray" else [])
    depths = [views.depth_map(lf, 0.93 * g, 1.07 * g, planes=41).depth.values for lf in ways]
    if not all(np.isfinite(depth).any() for depth in depths):
        return None
    # Aberrations beyond defocus move depths by the texture.
    beyond = float(np.linalg.norm(camera.wavefront[4:]))
    bound = 0.008 if model == "wave" or "detector_blur" in draw.options else 0.005
    return max(abs(float(np.nanmedian(depth)) / g - 1) for depth in depths), bound + 0.06 * beyond


@relation(Use.DECODING | Use.RAYS, MOVING, "depth")
def depth_of_dim_light(draw):
    """Depths of a wall and their confidences have no unit of light."""
    g = draw.camera.focus_distance * 1.03
    image = mp.render_capture(wall(draw.camera, g), model="ray", spp=16).image
    lfs = [mp.decode(image * unit, camera=draw.camera) for unit in (1, 1e-6)]
    one, other = (views.depth_map(lf, 0.97 * g, 1.03 * g, planes=12) for lf in lfs)
    return float(np.abs(np.nan_to_num([one.depth / other.depth - 1, one.confidence - other.confidence])).max()), 0.001
