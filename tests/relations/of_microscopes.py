"""Relations of microscopes in the Fourier arrangement: random ones, whose numbers are not those of other cameras."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
from camera_draws import OPTIONS
from of_captures import sky
from relation import off, relation

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.camera.entry import Use

ALL = " ".join(OPTIONS)


def microscope(rng):
    """Return a microscope of some lenses across the stop, with a field stop whose image fits a pitch."""
    immersion = float(rng.choice([1.0, 1.33, 1.515]))
    magnification, aperture = float(rng.choice([20, 40, 60])), float(rng.uniform(0.3, 0.85)) * immersion
    pitch, z, focal_length = float(rng.uniform(0.4, 1.2)), float(rng.uniform(10, 25)), float(rng.uniform(60, 150))
    across = 2 * focal_length * aperture / magnification / pitch
    focal_length *= float(rng.uniform(2.2, 3.2)) / across
    lens = mp.Objective(
        magnification, aperture, immersion, arrangement="fourier", fourier_focal_length=focal_length,
        field_stop=0.4 * pitch * focal_length / z, field_stop_shape=str(rng.choice(["disc", "square"])),
    )  # fmt: skip
    pixel = float(rng.uniform(1, 2.5)) * 550e-6 * z / pitch
    size = int(np.clip(3.6 * pitch / pixel, 60, 120)) // 2 * 2
    lattice = str(rng.choice(["square", "hexagonal"]))
    focal_lengths = [(1.0,), (1.0,), (0.97,)] + [(1.0, 0.97, 1.04)] * (lattice == "hexagonal")
    focal_lengths = tuple((z * np.array(focal_lengths[rng.integers(len(focal_lengths))])).tolist())
    return mp.PlenopticCamera(
        main_lens=lens, mla_pitch=pitch,
        mla_focal_length=focal_lengths, detector_distance=z, mla_lattice=lattice,
        mla_rotation=float(rng.choice([0.0, 11.0])), mla_aperture=str(rng.choice(["cell", "circle"])),
        mla_offset=tuple((pitch * rng.uniform(-0.5, 0.5, 2)).tolist()),
        detector_width=size * pixel, resolution=(size, size),
    )  # fmt: skip


def plane(camera, rng, s=1.0, mirrored=False):
    """Return the scene of a textured plane that fills the field, s times as large, tilted and out of focus."""
    texture = mi.Bitmap(np.ascontiguousarray(rng.random((6, 6, 1), np.float32)[:, :: -1 if mirrored else 1]))
    radiance = {"type": "bitmap", "bitmap": texture, "filter_type": "nearest", "raw": True}
    half, depth = 2 * camera.main_lens.field_stop / camera.main_lens.magnification, s * float(rng.uniform(-5e-3, 5e-3))
    place = mi.ScalarTransform4f().translate([0, 0, depth]).rotate([0, 1, 0], 190 if mirrored else 170).scale(half)
    shape = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}
    return mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": camera.to_sensor(), "plane": shape})


@relation(Use(0), ALL, "Fourier microscopes")
def units_of_fourier_microscopes(draw):
    """Lengths twice as long: the same capture by the same rays, or by waves of twice the wavelength."""
    camera = microscope(draw.rng)
    lens, seed = camera.main_lens, int(draw.rng.integers(1000))
    of_lens = "tube_focal_length", "fourier_focal_length", "field_stop"
    doubled = {name: 2 * getattr(camera, name) for name in ("mla_pitch", "detector_distance", "detector_width")}
    other = camera.replace(
        main_lens=replace(lens, **{name: 2 * getattr(lens, name) for name in of_lens}),
        mla_focal_length=tuple(2 * value for value in camera.mla_focal_lengths),
        mla_offset=tuple(2 * value for value in camera.mla_offset),
        **doubled,
    )
    model = str(draw.rng.choice(["ray", "wave"]))
    one, two = (
        mp.render_capture(
            plane(each, np.random.default_rng(seed), s), model=model, spp=4,
            **({"wavelength": 550 * s} if model == "wave" else {}),
        ).image
        for each, s in ((camera, 1.0), (other, 2.0))
    )  # fmt: skip
    return off(two, one), 0.01


@relation(Use(0), ALL, "Fourier microscopes")
def light_of_fourier_microscopes(draw):
    """Of a white world the whole lenses read 1, and waves keep the light of rays but for what leaves the detector."""
    camera = microscope(draw.rng)
    ray, wave = (
        mp.render_capture(
            sky(camera), model=model, spp=64, **({"wavelength": 550.0} if model == "wave" else {})
        ).image.astype(float)
        for model in ("ray", "wave")
    )
    index, lit = mp.design.lenses_in_stop(camera)
    place = np.stack(camera.lattice.centre(*index.T), -1) / camera.pixel_size + np.array(camera.resolution) / 2
    inside = (place > 3).all(1) & (place < np.array(camera.resolution) - 3).all(1)
    means = []
    for (x, y), part in zip(place[inside], lit[inside], strict=True):
        around = ray[int(y) - 2 : int(y) + 3, int(x) - 2 : int(x) + 3]
        means.append(abs(around.mean() - part))
    return max([*means, abs(float(wave.sum() / ray.sum()) - 1) - 0.03]), 0.08


def of_noise(draw, camera, other, inside=np.s_[:], mirrored=False):
    """Return how far a capture by another microscope is from part of one by the first, in stated deviations."""
    seed, model = int(draw.rng.integers(1000)), str(draw.rng.choice(["ray", "wave"]))
    one, two = (
        mp.render_capture(
            plane(each, np.random.default_rng(seed), mirrored=turned), model=model, spp=256, seed=number, noise=True,
            **({"wavelength": 550.0} if model == "wave" else {}),
        )
        for number, (each, turned) in enumerate(((camera, False), (other, mirrored)))
    )  # fmt: skip
    there, noise = ((array[:, ::-1] if mirrored else array) for array in (two.image, np.asarray(two.noise, float)))
    stated = np.sqrt((noise**2 + np.asarray(one.noise, float)[inside] ** 2).sum())
    return float(np.linalg.norm(there - one.image[inside]) / stated)


@relation(Use(0), ALL, "Fourier microscopes")
def crop_of_fourier_microscopes(draw):
    """A crop is the same pixels of the whole, within stated noise."""
    camera = microscope(draw.rng)
    size = camera.resolution[0]
    x, y, width, height = draw.rng.integers(
        [0, 0, size // 3, size // 3], [size // 3] * 2 + [2 * size // 3] * 2
    ).tolist()
    other = camera.replace(crop_offset=(x, y), crop_size=(width, height))
    return of_noise(draw, camera, other, np.s_[y : y + height, x : x + width]), 1.4


@relation(Use(0), ALL, "Fourier microscopes")
def mirror_of_fourier_microscopes(draw):
    """The mirrored plane by the mirrored microscope: the mirrored capture, within stated noise."""
    camera = microscope(draw.rng)
    lengths, (x, y) = camera.mla_focal_lengths, camera.mla_offset
    turned = {"mla_offset": (-x, y), "mla_rotation": -camera.mla_rotation}
    other = camera.replace(mla_focal_length=lengths[:1] + lengths[:0:-1], **turned)
    return of_noise(draw, camera, other, mirrored=True), 1.4
