"""Particles and their images: densities, what enters and leaves, image positions, total light, rays against waves."""

import json

import numpy as np
import pytest
import xarray as xr
from numpy.polynomial import legendre
from numpy.testing import assert_allclose
from refusals import refused, refuses
from scattering_cases import needs_miepython, one_particle
from scipy.special import spherical_jn, spherical_yn

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import particles as pt
from mitsuba_plenoptic.dataset import make_dataset, parse_recipe

CAMERA = mp.PlenopticCamera(detector_width=1.024, resolution=(256, 256))
FAST = CAMERA.replace(aperture_radius=22.2)
VOLUME = pt.ParticleVolume((-0.7, -0.7, 230), (0.7, 0.7, 250))


def sequence(flow=None, count=40.0, volume=VOLUME, sheet=None, frames=2, interval=0.1, **seeding):
    flow = flow or pt.Uniform((1.0, 0.0, 0.0))
    given = pt.Seeding(count=count, **seeding)
    return pt.particle_sequence(CAMERA, volume, given, flow, interval=interval, frames=frames, sheet=sheet, seed=4)


def test_densities_are_those_asked_for():
    # 1.4 mm at 240 mm are 0.7 mm at 120 mm, which 0.7 / 0.064 lenses cover along an axis.
    lenses, contents = (0.7 / 0.064) ** 2, 1.4 * 1.4 * 20
    for given, expected in (({"per_lens": 20.0}, 20 * lenses), ({"per_volume": 60.0}, 60 * contents)):
        seeding = pt.Seeding(**given, diameter=1.0)
        truth = pt.particle_sequence(CAMERA, VOLUME, seeding, pt.Uniform((0, 0, 0)), interval=1.0, frames=1)
        count = int(truth["inside"][0].sum())
        assert abs(count - expected) < 5 * expected**0.5, given
        position = truth["position"][0].values
        assert VOLUME.contains(position).all()
        # Even: mean and variance of each coordinate within five standard errors.
        place = (position - VOLUME.lower) / VOLUME.size
        assert np.abs(place.mean(0) - 0.5).max() < 5 / (12 * count) ** 0.5
        assert np.abs(place.var(0) - 1 / 12).max() < 5 * (1 / 180 / count) ** 0.5


@pytest.mark.parametrize(
    "flow",
    [pt.TaylorGreen(speed=10.0, length=0.35, axis="x", centre=(0, 0.1, 240)), pt.Uniform((9.0, -4.0, 100.0))],
)
def test_particles_enter_and_leave_and_their_number_stays(flow):
    truth = sequence(flow, count=4000.0, diameter=1.0, frames=4, interval=0.03)
    inside = truth["inside"].values == 1
    assert (np.abs(inside.sum(1) - 4000) < 5 * 4000**0.5).all() and inside.any(0).all()
    left, entered = (inside[0] & ~inside[3]).sum(), (~inside[0] & inside[3]).sum()
    assert left > 400
    assert abs(left - entered) < 5 * (left + entered) ** 0.5
    for frame in range(4):
        # As many everywhere, also where particles entered.
        there = truth["position"][frame].values[inside[frame]]
        parts = np.histogramdd(there, [4, 4, 4], list(zip(VOLUME.lower, VOLUME.upper, strict=True)))[0]
        assert np.abs(parts - parts.mean()).max() < 5 * parts.mean() ** 0.5
    assert_allclose((truth["position"] + truth["displacement"])[:3], truth["position"][1:], atol=1e-9)
    assert_allclose(flow.advected(truth["position"][1].values, 0.03), truth["position"][2], atol=1e-9)


def test_sheets_light_what_is_within_them():
    truth = sequence(count=500.0, sheet=pt.LightSheet(thickness=6.0))
    lit = np.abs(truth["position"].values[..., 2] - 240) < 3
    assert (truth["irradiance"].values == lit).all()
    sheet = pt.LightSheet(thickness=6.0, profile="gaussian")
    assert_allclose(sheet.irradiance(np.array([[0, 0, 240.0], [9, 9, 243.0]]), VOLUME), [1, np.exp(-2)])


def test_rays_by_snells_law_come_from_where_particles_are_seen(recwarn):
    """Rays near the normal, traced out of the fluid, meet there; those of the rim are as much longer as warned of."""
    window, place = pt.Window(90.0, 1.5), np.array([[0.3, -0.2, 120.0]])
    seen = window.apparent(place, CAMERA, 550)[0]
    for angle in (-1e-3, 2e-3):
        # On the way to the window, and on from there towards the camera.
        height = place[0, 0] + 30 * np.tan(np.arcsin(np.sin(angle) / 1.5))
        assert height + np.tan(angle) * (90 - seen[2]) == pytest.approx(seen[0], abs=1e-7)
    # Of the whole path from a particle on the axis to the rim against that on the axis, less that in air alone.
    camera = CAMERA.replace(aperture_radius=12.0)
    for depth, sharp in ((2.0, True), (4.0, False)):
        sine = 12 / np.hypot(12, 90 + depth / 1.5)
        path = depth * (np.sqrt(1.5**2 - sine**2) - np.sqrt(1 - sine**2) / 1.5 - 1.5 + 1 / 1.5)
        assert (abs(path) < 550e-6 / 14) == sharp
        window.apparent([[0, 0, 90 + depth]], camera, 550)
        assert len(recwarn) == (not sharp)


def behind_window(place, pupil, medium=1.333):
    """Return the ways from where a particle is seen, 0.1 mm behind its window, and unit vectors there in the fluid."""
    away = pupil - place + [0, 0, 0.1 * (1 - 1 / medium)]
    sines = away[..., :2] / np.linalg.norm(away, axis=-1, keepdims=True) / medium
    return away, np.concatenate([sines, -np.sqrt(1 - (sines**2).sum(-1, keepdims=True))], -1)


def mie(diameter, index, wavelength, cosine):
    """Return S1 and S2 by Bohren and Huffman's equations 4.53 and 4.74, with Legendre's polynomials."""
    x = np.pi * diameter * 1e3 / wavelength
    n = np.arange(1, int(x + 4.05 * np.cbrt(x) + 3))
    j, inner = spherical_jn(n, x), spherical_jn(n, index * x)
    h, slope = j + 1j * spherical_yn(n, x), spherical_jn(n, x, True)
    xj, within = j + x * slope, inner + index * x * spherical_jn(n, index * x, True)
    xh = h + x * (slope + 1j * spherical_yn(n, x, True))
    a, b = ((q * inner * xj - j * within) / (q * inner * xh - h * within) for q in (index**2, 1))
    weight = (2 * n + 1) / (n * (n + 1))

    def series(one, other):
        # pi is the derivative P', and tau is n (n + 1) P - cos P'.
        prime, second = (legendre.legder(np.append(0, weight * part)) for part in (one, other))
        turned = legendre.legval(cosine, np.append(0, (2 * n + 1) * other))
        return legendre.legval(cosine, prime) + turned - cosine * legendre.legval(cosine, second)

    return series(a, b), series(b, a)


@needs_miepython
@pytest.mark.parametrize(("depth", "diameter"), [(24.3, 3.0), (23.5, 20.0)])
def test_images_of_spheres_are_those_of_coherent_points_with_their_amplitudes(depth, diameter):
    """Points around the particle whose light adds coherently to that which S1 and S2 have on the pupil."""
    # Small, so that fields are: they are sampled over the whole pupil.
    short = {"focal_length": 8, "mla_distance": 12, "aperture_radius": 0.624, "mla_focal_length": 0.615}
    camera, place = CAMERA.replace(detector_width=0.256, resolution=(64, 64), **short), (0.03, -0.02, depth)
    images = pt.ParticleImages(one_particle(place, camera, diameter=diameter), wavelength=550)
    at = np.linspace(-1, 1, 30) * camera.aperture_radius
    pupil = np.stack(np.meshgrid(at, at, 0.0), -1).reshape(-1, 3)
    pupil = pupil[np.hypot(*pupil.T[:2]) < 1.05 * camera.aperture_radius]
    away, within = behind_window(place, pupil)
    cosine = within[:, 0]
    place = (pupil - away)[0]
    beside = np.linspace(-1, 1, 11) * (1e-3 * diameter + 0.01)
    points = place + np.stack(np.meshgrid(beside, beside, 0.0), -1).reshape(-1, 3)
    path = np.linalg.norm(pupil[:, None] - points, axis=-1) - np.linalg.norm(points, axis=-1)
    path -= (np.linalg.norm(away, axis=1) - np.linalg.norm(place))[:, None]
    waves, expected = np.exp(2j * np.pi * path / 550e-6), 0
    operator = mp.CaptureOperator(camera, points, wavelength=550, accuracy=0)
    for scattered in mie(diameter, 1.59 / 1.333, 550 / 1.333, cosine):
        sources = np.linalg.lstsq(waves, scattered, rcond=1e-7)[0]
        assert np.linalg.norm(waves @ sources - scattered) < 2e-3 * np.linalg.norm(scattered)
        expected = expected + operator.coherent_fields.intensity(sources.astype(np.complex64)).reshape(64, 64)
    image = images.capture(0).image
    error = image / image.sum() - expected / expected.sum()
    # The root of the power in the place of the amplitudes is 8 and 10 % off.
    assert np.linalg.norm(error) < 0.003 * np.linalg.norm(expected / expected.sum())


@needs_miepython
@pytest.mark.parametrize(
    ("camera", "diameter", "direction"),
    [(CAMERA, 50.0, (1, 0, -1)), (FAST, 3.0, (0, 1, 0)), (FAST, 20.0, (0.3, 1, 0.4))],
)
def test_powers_are_integrals_over_the_pupil(camera, diameter, direction):
    for place in ([0.3, -0.2, 240.0], [-0.5, 0.6, 250.0]):
        truth = one_particle(place, camera, diameter, direction)
        found = pt.ParticleImages(truth, wavelength=550, model="ray").metadata(0)["reference"]
        angle = 2 * np.pi * np.arange(60) / 60
        radius = camera.aperture_radius * np.sqrt((np.arange(250) + 0.5) / 250)[:, None]
        pupil = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * radius * angle], -1)
        away, within = behind_window(place, pupil)
        distance = np.linalg.norm(away, axis=-1)
        cosine = within @ np.array(direction) / np.linalg.norm(direction)
        power = np.square(np.abs(mie(diameter, 1.59 / 1.333, 550 / 1.333, cosine))).sum(0)
        # A square of the pupil over the window is the same on both sides, n^2 cos theta times the solid angle.
        solid = away[..., 2] ** 2 / distance**4 / (1.333**2 * -within[..., 2])
        power = power / (2 * (2 * np.pi * 1.333 / 0.55) ** 2) * solid
        assert found == pytest.approx(np.pi * camera.aperture_radius**2 * power.mean(), rel=2e-3)


@needs_miepython
def test_light_over_the_pupil_is_that_of_single_angles():
    # In focus each pixel below the only lens sees one place of the pupil; lobes of 40 micrometres are narrower than it.
    box = pt.ParticleVolume((0.05, 0.05, 239.95), (0.06, 0.06, 240.05))
    truth = sequence(pt.Uniform((0, 0, 0)), count=8.0, diameter=0.05, frames=1, volume=box).isel(particle=[0])
    truth["diameter"][:] = 40.0
    place = truth["position"].values[0, 0]
    image = pt.ParticleImages(truth, wavelength=550, model="ray").capture(0).image.astype(float)
    column = np.flatnonzero(image.sum(0))
    # A ray through the pupil's x meets the array at m = -X / 2, and the detector at c + z (m - x) / b.
    at, centre, meets = (column - 127.5) * CAMERA.pixel_size, -0.032, -place[0] / 2
    edges = meets - (at[:, None] - centre + np.linspace(-0.5, 0.5, 21) * CAMERA.pixel_size) * 120 / 0.512
    across = np.linspace(-5, 5, 101)
    towards = np.stack(np.broadcast_arrays(edges[..., None], across, 0.0), -1) - place
    cosine = (towards[..., 0] / np.linalg.norm(towards, axis=-1) / 1.333).reshape(1, -1)
    section = pt.cross_sections(np.array([40.0]), 1.59 / 1.333, 550 / 1.333, cosine).reshape(towards.shape[:-1])
    open_ = np.hypot(edges[..., None], across) < 5
    expected, flat = (section * open_).mean((1, 2)), open_.mean((1, 2))
    seen = image.sum(0)[column]
    assert_allclose(seen / seen.sum(), expected / expected.sum(), atol=0.006)
    assert np.abs(flat / flat.sum() - expected / expected.sum()).max() > 0.03


@needs_miepython
def test_files_hold_sequences(tmp_path):
    truth = sequence(count=5.0, diameter=2.0, spread=0.2, index=1.5 + 0.01j)
    truth.to_netcdf(tmp_path / "truth.nc")
    again = xr.load_dataset(tmp_path / "truth.nc")
    capture, other = (pt.ParticleImages(each, wavelength=550, model="ray").capture(1) for each in (truth, again))
    assert (capture.image == other.image).all()
    mp.write_capture(tmp_path / "frame.exr", capture)
    assert mp.read_capture(tmp_path / "frame.exr").metadata["particles"]["flow"]["kind"] == "Uniform"


test_bad_input_is_refused_in_one_line = refused(
    (lambda: sequence(volume=pt.ParticleVolume((0, 0, -5), (1, 1, 5))), "z = -5"),
    (lambda: sequence(volume=pt.ParticleVolume((0, 0, 80), (1, 1, 90))), "focus at 80"),
    (lambda: pt.ParticleVolume((0, 0, 240), (1, 0, 250)), "empty"),
    (lambda: sequence(pt.Uniform((20, 0, 0))), "particles move by 2 mm along x .* 1.4 mm"),
    (lambda: sequence(Jet(), count=3000.0, diameter=1.0), "particles move by .* mm along x"),
    (lambda: sequence(count=1e6, diameter=0.1, frames=300), "frames = 300: 2.*e.07 particles"),
    (lambda: sequence(count=1e4, diameter=200.0), "cover 1.6e4%|cover 16029%"),
    (lambda: pt.Seeding(count=3, per_lens=1), "per_lens, per_volume, count"),
    (lambda: sequence(window=231), "window = 231.* z = 230"),
    (lambda: pt.Seeding(count=1, index=1.333), "as that of the medium"),
    (lambda: pt.LightSheet(direction=(0, 0, 1), thickness=3), "along its sheet"),
    (lambda: images_of(pt.LightSheet(thickness=1, centre=(0, 0, 300))), "no particle is lit"),
    (lambda: pt.ParticleImages(sequence(), wavelength=550, model="ray", accuracy=0.1), "accuracy"),
)


def images_of(sheet, **given):
    return pt.ParticleImages(sequence(sheet=sheet, **given), wavelength=550)


class Jet(pt.Flow):
    """Narrower than the distance of the places at which flows are tried."""

    def velocity(self, points):
        return np.where(np.abs(points[:, 1:2] - 0.0875) < 0.05, [[20.0, 0, 0]], 0)


@needs_miepython
def test_data_sets_hold_pairs(tmp_path):
    recipe = {
        "count": 1,
        "camera": {"detector_width": 0.512, "resolution": [128, 128]},
        "scenes": [{"generator": "particles", "flow": "lamb_oseen", "per_lens": 0.1, "displacement": 2}],
        "models": ["ray"],
        "noise": {"photons": 1e5},
    }
    refuses("truth: scenes: generator particles makes no scenes; give an empty list", parse_recipe, recipe)
    sample = make_dataset(parse_recipe(recipe | {"truth": []}), tmp_path / "pairs")[0]
    position, displacement = (sample.arrays[f"particle_{name}"] for name in ("position", "displacement"))
    both = np.isfinite(position).all((0, 2))
    assert_allclose((position[0] + displacement[0])[both], position[1][both], atol=1e-4)
    # Of two lens pitches, 0.128 mm at twice the distance; particles are elsewhere than the places it is set at.
    assert 0.1 < np.nanmax(np.linalg.norm(displacement, axis=-1)) < 0.28
    assert sample.capture_called("ray_next_exposed", "ray").metadata["frame"] == 1
    assert "the second capture by rays, with the noise" in (tmp_path / "pairs" / "README.md").read_text()


@needs_miepython
def test_the_command_writes_pairs(run, complaint, tmp_path):
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"detector_width": 0.512, "resolution": [128, 128]}))
    common = ["particles", "-o", tmp_path / "pair", "--camera", camera, "--volume", "-0.3,-0.3,236,0.3,0.3,244"]
    common += ["--count", "5", "--flow", "hill:speed=1,radius=0.5", "--interval", "0.1"]
    assert "lit in the first frame" in run(*common)
    run(*common, "--model", "ray", "--photons", "1e5")
    names = ["particles.nc", "ray_0000.exr", "ray_0001.exr", "wave_0000.exr", "wave_0001.exr"]
    assert sorted(path.name for path in (tmp_path / "pair").iterdir()) == names
    truth = xr.load_dataset(tmp_path / "pair" / "particles.nc")
    assert json.loads(truth.attrs["particles"])["flow"]["centre"] == [0, 0, 240]
    assert mp.read_capture(tmp_path / "pair" / "ray_0001.exr").metadata["exposure"]["photons"] == 1e5
    assert complaint(*common[:-4], "--flow", "hil", "--interval", "0.1").endswith("did you mean hill?")
