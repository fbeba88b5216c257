"""Beads before a light-field microscope: rays against Mitsuba's, light by angle, positions found again."""

import mitsuba as mi
import numpy as np
import pytest
from cases import facing, film, radiating, scene_of
from numpy.testing import assert_allclose
from refusals import refused, refuses
from scattering_cases import needs_miepython, one_particle

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import particles as pt
from mitsuba_plenoptic.array import Lenslet
from mitsuba_plenoptic.dataset import make_dataset, parse_recipe
from mitsuba_plenoptic.extensions.inverse.point_rays import PointRays
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.points.pupil_weights import PupilWeights
from mitsuba_plenoptic.rays.tracer import Passage, Walk

CAMERA = mp.PlenopticCamera.preset("lfm_water").replace(detector_width=0.875, resolution=(105, 105))


@pytest.mark.slow
def test_points_by_rays_are_those_of_the_sensor():
    """A small lamp out of focus, whose light falls with the cosine, as points that Mitsuba's rays find."""
    place, half = np.array([0.003, -0.002, 0.012]), 0.003
    lamp = facing(place[2], half, tuple(place[:2]), **radiating())
    scene = scene_of({**CAMERA.to_sensor(), "film": film(105, 105)}, "direct", lamp=lamp)
    traced = np.array(mi.render(scene, spp=2048))[..., 0]
    side = (np.arange(12) + 0.5) / 6 - 1
    points = place + half * np.stack(np.broadcast_arrays(side, side[:, None], 0.0), -1).reshape(-1, 3)
    cells = (np.arange(32) + 0.5) / 16 - 1
    cosine = np.sqrt(1 - (cells**2 + cells[:, None] ** 2) * (0.5 / 1.33) ** 2)
    weights = PupilWeights.of(np.broadcast_to(cosine, (len(points), 32, 32)), len(points))
    image = PointRays(CAMERA, points, 550.0, weights).image(OpticalSystem(CAMERA, 550.0), np.ones(len(points)))
    image *= traced.sum() / image.sum()
    assert np.linalg.norm(image - traced) < 0.04 * np.linalg.norm(traced)


def test_the_light_of_a_bead_is_that_of_the_cone():
    """The volume of a sphere, times the part of all directions within the cone of rays in the fluid."""
    truth = one_particle((0, 0, 0.03), CAMERA, index=None, diameter=0.8)
    found = pt.ParticleImages(truth, wavelength=550, model="ray").metadata(0)["reference"]
    cone = (1 - np.cos(np.arcsin(0.5 / 1.333))) / 2
    assert_allclose(found, np.pi / 6 * 0.8**3 * cone, rtol=1e-4)


ODD = mp.PlenopticCamera(
    detector_width=1.024, resolution=(256, 256), mla_lattice="hexagonal", mla_rotation=5.0, crop_offset=(20, 30),
    crop_size=(180, 190),
)  # fmt: skip


@pytest.mark.parametrize(
    ("model", "camera", "place", "before"),
    [("wave", ODD, (0.11, -0.07, 263.0), 1), ("ray", CAMERA, (0.004, 0.003, 0.06), 1.33)],
)
def test_a_bead_is_imaged_as_the_point_where_it_is_seen(model, camera, place, before):
    seen = np.array([[*place[:2], place[2] - 0.3 + 0.3 * before / 1.4]])
    if model == "ray":
        expected = PointRays(camera, seen, 550.0).image(OpticalSystem(camera, 550.0), np.ones(1))
    else:
        expected = mp.CaptureOperator(camera, seen, wavelength=550).forward([1.0])
    # The last one is in what the camera is in, and has the bits of the point.
    for at, kind in ((place, {"medium": 1.4, "window": place[2] - 0.3}), (seen[0], {"medium": before})):
        truth = one_particle(at, camera, index=None, **kind)
        image = pt.ParticleImages(truth, wavelength=550, model=model).capture(0).image
        assert np.linalg.norm(image - expected) < 1e-3 * np.linalg.norm(expected)
    assert (image == np.maximum(expected, 0).astype(np.float32)).all()


@needs_miepython
def test_lobes_are_at_the_angles_of_the_rays():
    """In focus behind one lens each pixel sees one direction, that of the sensor's ray through the lens's centre."""
    # Seen in the plane in focus, through a window 0.1 mm before the bead.
    medium = 1.4
    place = (0, 0, 0.1 * (1 - 1.33 / medium))
    truth = one_particle(place, CAMERA, diameter=2.0, medium=medium)
    image = pt.ParticleImages(truth, wavelength=550, model="ray").capture(0).image.astype(float)
    # Of the even bead, to leave the aperture and the apodisation out.
    even = one_particle(place, CAMERA, index=None, diameter=2.0, medium=medium)
    flat = pt.ParticleImages(even, wavelength=550, model="ray").capture(0).image.astype(float)
    seen = flat > 0.7 * flat.max()
    rows, columns = np.nonzero(seen)
    x, y = ((index - 52) * CAMERA.pixel_size for index in (columns, rows))
    _, slope, is_open = Walk.of(CAMERA).trace((x, y), Passage((0 * x, 0 * y), Lenslet((0 * x, 0 * y), 2.433)))
    assert is_open.all() and seen.sum() > 100
    # By Snell's law.
    cosine = -slope[0] / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2) * 1.33 / medium
    expected = pt.cross_sections(np.array([2.0]), 1.59 / medium, 550 / medium, cosine[None])[0]
    ratio = image[seen] / flat[seen]
    assert_allclose(ratio / ratio.mean(), expected / expected.mean(), rtol=0.12)
    other_way = pt.cross_sections(np.array([2.0]), 1.59 / medium, 550 / medium, -cosine[None])[0]
    assert np.corrcoef(ratio, expected)[0, 1] > 0.98 > 0.8 > np.corrcoef(ratio, other_way)[0, 1]


def test_densities_and_elongation_are_those_of_the_microscope():
    box = pt.ParticleVolume((-0.0125, -0.0125, -0.01), (0.0125, 0.0125, 0.01))
    # 25 um are four lenses of 6.25 um in the object.
    assert box.lenses(CAMERA, pt.Window()) == pytest.approx(16)
    cosine = np.sqrt(1 - (0.5 / 1.33) ** 2)
    steps = np.linspace(cosine, 1, 20001)
    # The mean over directions of the squared tangent, of which either axis has half.
    assert pt.elongation(CAMERA, 0.01) == pytest.approx((1 / steps**2 - 1).mean() ** -0.5, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["ray", "wave"])
def test_positions_of_beads_are_found(model):
    """In a capture with noise: by SIRT within 0.25 voxels, 0.75 along the axis, and by least squares within 0.05."""
    medium = 1.35
    places = np.array([[0.0042, -0.0031, 0.0143], [-0.0057, 0.0048, 0.0192]])
    truth = one_particle(places[0], CAMERA, index=None, window=-0.1, medium=medium).isel(particle=[0, 0])
    truth["position"][0] = places
    capture = pt.ParticleImages(truth, wavelength=510, model=model).capture(0)
    capture = mp.expose(capture, mp.Detector(full_well=1e5, bits=16), photons=1e5)
    grid = pt.VoxelGrid((-0.01, -0.01, 0.011), (0.01, 0.01, 0.023), (6, 10, 10))
    window = pt.Window(-0.1, medium)
    if model == "ray":
        projector = pt.RayProjector(CAMERA, grid, wavelength=510, window=window)
    else:
        projector = mp.StoredOperator(CAMERA, window.apparent(grid.points, CAMERA, 510), wavelength=510, accuracy=0.1)
    volume = pt.reconstruct_volume(projector, capture, grid, method="sirt", iterations=60)
    found, light = pt.locate_particles(volume, threshold=0.3, apart=(5, 5, 5))
    assert len(found) == 2
    found, light = found[np.argsort(found[:, 2])], light[np.argsort(found[:, 2])]
    assert (np.abs(found - places) / grid.voxel / (0.25, 0.25, 0.75)).max() < 1
    if model == "wave":
        found, _ = pt.refine_particles(capture, found, light)
        assert (np.abs(found - places) / grid.voxel).max() < 0.05


test_bad_microscopes_are_refused_in_one_line = refused(
    (lambda: one_particle((0, 0, -12.0), CAMERA), "z = -12.* z = -11.97"),
    (lambda: one_particle((0, 0, 0.1), OILY), "medium=1.333.* 1.4"),
    (lambda: pt.RayProjector(FOURIER, pt.VoxelGrid((0, 0, 0), (1, 1, 1), (1, 1, 1)), wavelength=550), "objective"),
)


OILY = CAMERA.replace(main_lens=mp.Objective(40, 1.4, 1.515))
FOURIER = mp.PlenopticCamera(
    main_lens=mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50), mla_pitch=0.5, mla_focal_length=20
)


@needs_miepython
def test_data_sets_of_a_microscope(tmp_path):
    scene = {"generator": "particles", "flow": "uniform", "per_lens": 0.1, "diameter": 0.5, "displacement": 1}
    camera = {"preset": "lfm_water", "detector_width": 0.875, "resolution": [105, 105]}
    recipe = {"count": 1, "camera": camera, "models": ["ray"], "truth": []}
    refuses("near and far", make_dataset, parse_recipe(recipe | {"scenes": [scene]}), tmp_path / "none")
    recipe |= {"scenes": [scene | {"near": -0.01, "far": 0.03}]}
    sample = make_dataset(parse_recipe(recipe), tmp_path / "pairs")[0]
    # Within 0.8 of the field of 0.875 mm / 20, and of one lens in the object.
    position, move = sample.arrays["particle_position"], sample.arrays["particle_displacement"]
    assert 0.01 < np.nanmax(np.abs(position[..., :2])) < 0.8 * 0.875 / 40
    assert np.nanmax(np.linalg.norm(move, axis=-1)) == pytest.approx(0.125 / 20, rel=1e-3)
