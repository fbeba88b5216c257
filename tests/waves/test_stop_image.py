"""Wave captures of microscopes in the Fourier arrangement against fields and sums of points."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.signal import fftconvolve
from scipy.special import j1

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.waves.stop_image import stop_lenses

WAVELENGTH = 550.0
FOUR = {"mla_pitch": 0.5, "mla_focal_length": 20.0, "mla_aperture": "circle", "mla_fill": 0.6}
"""Four whole lenses in the image of a stop of radius 0.61."""


def microscope(field_stop=0.3, size=50, **numbers):
    lens = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=24.4, field_stop=field_stop)
    usual = FOUR | {"detector_width": 0.02 * size, "resolution": (size, size)}
    return mp.PlenopticCamera(main_lens=lens, **(usual | numbers))


def captured(camera, shape, spp, wave=True, seed=0):
    child = {"type": "path", "max_depth": 2}
    integrator = {"type": "plenoptic_wave", "wavelength": WAVELENGTH, "child": child} if wave else child
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": camera.to_sensor(), "shape": shape})
    return mi.render(scene, spp=spp, seed=seed).numpy()[..., 0]


def square(x, y, depth, half):
    place = mi.ScalarTransform4f().translate([x, y, depth]).rotate([1, 0, 0], 180).scale(half)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": 1.0}}


def summed(camera, x, y, depth, half, order=10):
    """Sum of full fields of points of a square, by Gauss's rule."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    points = [(x + half * a, y + half * b, depth) for a in nodes for b in nodes]
    operator = mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field")
    return operator.forward(np.outer(weights, weights).ravel())


def difference(image, expected):
    """Relative difference, with the brightness of the expected image fitted."""
    expected = expected * (image * expected).sum() / (expected**2).sum()
    return np.linalg.norm(image - expected) / np.linalg.norm(expected)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [0.0, 0.05])
def test_beads_are_those_of_full_fields(depth):
    # Light out of focus is not cut by the field stop.
    camera = microscope(0.6)
    bead = (0.002, -0.003, depth, 0.006)
    image = captured(camera, square(*bead), 16384)
    # Each lens takes a quarter of the stop, over which rays bend unevenly.
    assert difference(image, summed(camera, *bead)) < (0.01 if depth == 0 else 0.03)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [0.0, 0.02, -0.02, 0.06, -0.06])
def test_beads_behind_whole_and_cut_lenses_are_those_of_full_fields(depth):
    lens = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50, field_stop=1.2)
    camera = mp.PlenopticCamera(
        main_lens=lens, mla_pitch=0.5, mla_focal_length=20, mla_lattice="hexagonal", detector_width=3.6,
        resolution=(360, 360),
    )  # fmt: skip
    index, lit = mp.design.lenses_in_stop(camera)
    bead = (0.0, 0.0, depth, 0.003)
    centres = np.stack(camera.lattice.centre(*index.T), -1)
    cut = centres[np.argmin(np.where(lit < 0.5, np.hypot(centres[:, 0] - 1.25, centres[:, 1]), np.inf))]
    for centre, limit in (((0.0, 0.0), 0.02), (cut, 0.045)):
        sines = np.array(centre) * 20 / 50
        place = np.array(centre) - 20 * 20 / 50 * depth * sines / np.sqrt(1 - sines @ sines)
        corner = np.rint(place / 0.01 + 180 - 20).astype(int)
        one = camera.replace(crop_offset=tuple(corner.tolist()), crop_size=(40, 40))
        assert difference(captured(one, square(*bead), 16384), summed(one, *bead)) < limit, (centre, depth)


def test_a_textured_plane_is_a_sum_of_airy_patterns():
    """In focus each lens spreads all points alike, by the transform of its aperture."""
    camera = microscope()
    texels = np.random.default_rng(1).random((12, 12)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels[..., None]), "raw": True, "filter_type": "nearest"}
    wide = 0.012  # half width in the object; 0.3 / 20 is the field's radius
    place = mi.ScalarTransform4f().rotate([1, 0, 0], 180).scale(wide)
    plane = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": texture}}
    fine = 3
    wave = captured(camera, plane, 512)
    ray = captured(camera.replace(resolution=(50 * fine, 50 * fine)), plane, 128, wave=False)
    along = np.arange(-40 * fine, 40 * fine + 1) * 0.02 / fine
    # The pattern of a lens of diameter 0.3, with the light of an area that is a sample.
    spread = np.pi * 0.3 / (WAVELENGTH * 1e-6 * 20)
    radius = np.hypot(along, along[:, None]) * spread + 1e-9
    airy = (spread / np.pi) ** 2 * np.pi / 4 * (0.02 / fine) ** 2 * (2 * j1(radius) / radius) ** 2
    expected = fftconvolve(ray, airy, mode="same").reshape(50, fine, 50, fine).mean((1, 3))
    assert difference(wave, expected) < 0.02
    assert wave.sum() == pytest.approx(expected.sum(), rel=0.01)


@pytest.mark.parametrize("wave", [False, True])
def test_an_even_scene_reads_the_number_of_lenses(wave):
    constant = {"type": "constant", "radiance": 1.0}
    # Micro-images of radius 0.246 touch nearly; those of radius 0.5 overlap in the middle, where four lenses are seen.
    alone = captured(microscope(), constant, 16, wave)
    assert alone[9:16, 9:16].mean() == pytest.approx(1, abs=0.005 + 0.03 * wave)
    assert captured(microscope(0.61), constant, 16, wave)[23:27, 23:27].mean() == pytest.approx(
        4, abs=0.02 + 0.1 * wave
    )


def test_radiance_has_gradients():
    camera = microscope()
    scene = mi.load_dict(
        {"type": "scene", "integrator": {"type": "plenoptic_wave", "wavelength": WAVELENGTH},
         "sensor": camera.to_sensor(), "shape": square(0, 0, 0, 0.004)}
    )  # fmt: skip
    parameters = mi.traverse(scene)
    name = next(key for key in parameters.keys() if key.endswith("radiance.value"))  # noqa: SIM118
    dr.enable_grad(parameters[name])
    parameters.update()
    image = mi.render(scene, parameters, spp=64)
    dr.backward(dr.sum(image))
    # A capture is proportional to its only radiance, 1.
    assert dr.grad(parameters[name])[0] == pytest.approx(image.numpy().sum(), rel=0.01)


def test_equal_parts_of_lenses_are_of_one_kind():
    camera = microscope(mla_fill=1.0, mla_aperture="cell")
    lenses = stop_lenses(camera)
    # Four whole lenses, and eight that the edge cuts, each on another side.
    assert len(lenses.index) == 12
    assert len(set(np.round(lenses.area, 6))) == 2
    assert sorted(np.bincount(lenses.kind, minlength=len(lenses.parts)).tolist()) == [0] + [1] * 12
