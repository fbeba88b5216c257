"""Rays through surfaces: against stigmatic lenses, their own way back, Optiland, and differences."""

import json
from pathlib import Path

import numpy as np
import pytest
from drjit.llvm.ad import Float64

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import LensSystem, PlenopticCamera, Prescription
from mitsuba_plenoptic.lenses import main_lens, sequential
from mitsuba_plenoptic.prescription import paraxial
from mitsuba_plenoptic.prescription.surfaces import BUNDLED, bundled_prescription
from mitsuba_plenoptic.report.lens_quality import field_figures

RECORDS = Path(__file__).parents[1] / "optiland_records"
OPTILAND = json.loads((RECORDS / "results.json").read_text())["lenses"]
"""Results of Optiland 0.6.3."""


def camera_with(lens, **numbers):
    return PlenopticCamera(**({"main_lens": lens, "focal_length": 80, "aperture_radius": 5} | numbers))


def bundle(lens, count=300, seed=0):
    """Places on the array within 4 mm, and slopes to within the exit pupil."""
    place, pupil = np.random.default_rng(seed).uniform(-4, 4, (2, 2, count))
    return tuple(place), tuple((0.6 * pupil - place) / lens.pupil.distance)


def test_a_hyperboloid_makes_one_point_of_parallel_light():
    """A plano-convex lens with k = -n^2 is stigmatic at any aperture, with equal paths (Born and Wolf, 4.2.3)."""
    n, R = 1.5, -50.0
    surfaces = [
        {"thickness": 20, "glass": n, "semi_aperture": 30, "stop": True},
        {"radius": R, "conic": -(n**2), "semi_aperture": 30},
    ]
    lens = Prescription.from_plain({"surfaces": surfaces})
    y = np.linspace(-25, 25, 11)
    elements, start = sequential.elements(lens, 587.0), (0 * y, y, -5.0 + 0 * y)
    point, direction, is_open, path = sequential.follow(elements, start, (0 * y, 0 * y, 1 + 0 * y))
    left = (paraxial(lens).back_focal - point[2]) / direction[2]
    assert np.all(is_open)
    assert np.allclose(point[1] + left * direction[1], 0, atol=1e-10)
    assert np.ptp(path + left) < 1e-10


def test_strong_aspheres_are_met_where_light_meets_them():
    """From the corner of the phone lens's field, where conics miss its aspheres: rays of one point, through a pupil."""
    lens = LensSystem.of(PlenopticCamera(main_lens="phone", focus_distance=1e6))
    x, y = (values.ravel() for values in np.meshgrid(*[np.linspace(-2, 2, 81)] * 2))
    for height in (1.5, 2.75):
        _, slope, is_open = lens.ray((x, y), (0 * x, 0 * x + height))
        assert 0.7 < is_open.sum() * 0.05**2 / (np.pi * lens.pupil.radius**2) < 1.6
        assert np.ptp(slope[1][is_open]) < 0.02
        assert np.mean(slope[1][is_open]) == pytest.approx(-height / 4.1436, rel=0.01)


def test_chief_rays_pass_the_stop_where_the_paraxial_pupil_misleads():
    lens = LensSystem.of(PlenopticCamera(main_lens="phone", focus_distance=1e6))
    height, squares = np.array([1.0, 2.0, 2.75]), []
    slope = lens.chief_slope(height)
    N, surfaces = 1 / np.hypot(1, slope), sequential.elements(lens.prescription, lens.light, backwards=True)
    sequential.follow(surfaces, (0 * height, height, -lens.back_distance), (0 * N, slope * N, N), squares)
    assert np.abs(squares[-1]).max() < 1e-15


@pytest.mark.parametrize("name", BUNDLED)
def test_rays_go_back_the_way_they_came(name):
    lens = LensSystem.of(camera_with(name))
    place, slope = bundle(lens)
    point, there, is_open = lens.trace(place, slope)
    ahead = tuple(p + 50 * t for p, t in zip(point[:2], there, strict=True))
    back, again, open_too, _ = lens.through((*ahead, point[2] + 50), there)
    assert is_open.any()
    assert np.array_equal(is_open, open_too)
    assert np.allclose(back, place, atol=1e-9) and np.allclose(again, slope, atol=1e-11)


@pytest.mark.parametrize("name", BUNDLED)
def test_near_the_axis_it_is_the_thin_lens_of_its_principal_planes(name):
    lens = LensSystem.of(camera_with(name))
    for m, P in ((1e-3, 2e-3), (-1e-3, 1e-3)):
        slope = (P - m) / lens.pupil.distance
        point, there, _ = lens.trace((0.0, m), (0.0, slope))
        height = m + 120 * slope
        assert point[1] + (240 - point[2]) * there[1] == pytest.approx(-2 * m, abs=1e-8)
        assert there[1] == pytest.approx(slope - height / 80, abs=1e-9)


def test_distortion_is_that_of_a_grid_of_chief_rays():
    """Of the object point that a chief ray meets, against its paraxial image."""
    camera = camera_with("singlet", aperture_radius=2)
    lens, height = LensSystem.of(camera), 4.0
    point, slope, _ = lens.trace((0.0, height), (0.0, float(lens.chief_slope(height))))
    expected = -2 * height / (point[1] + (240 - point[2]) * slope[1]) - 1
    assert field_figures(main_lens(camera), [height], 240)[0].distortion == pytest.approx(expected, rel=1e-9)


def traced(lens, peer, wavelength, array):
    """Return where our rays meet the peer's image plane (2, n) and their paths from the start, in millimetres."""
    places, slopes = np.array(peer["places"]), np.array(peer["slopes"])
    N = 1 / np.sqrt(1 + np.sum(slopes**2, axis=0))
    start = (*(array(p - 30 * t) for p, t in zip(places, slopes, strict=True)), -30.0)
    # Whether the edges of surfaces would block them is not asked; Optiland's have none.
    cosines = tuple(array(v) for v in (slopes[0] * N, slopes[1] * N, N))
    (x, y, z), (L, M, N), _, path = sequential.follow(sequential.elements(lens, wavelength), start, cosines)
    left = (peer["image_distance"] - z) / N
    return np.array([x + left * L, y + left * M]), np.array(path + left)


def require_the_peers(lens, peer):
    """Check rays and paths at each wavelength in both precisions, and at the primary one focal length and pupils."""
    for array in (np.asarray, Float64):
        for wavelength, expected in peer["rays"].items():
            place, path = traced(lens, peer, float(wavelength), array)
            assert np.max(np.abs(place - expected["image"])) < 1e-6
            assert np.max(np.abs(path - expected["paths"])) / (float(wavelength) * 1e-6) < 2e-3
    numbers = paraxial(lens, peer["wavelength"])
    assert numbers.focal_length == pytest.approx(peer["focal_length"], rel=1e-7)
    assert numbers.entrance_pupil == pytest.approx(peer["entrance_pupil"], rel=1e-7)
    assert numbers.exit_pupil - peer["image_distance"] == pytest.approx(peer["exit_pupil"], rel=1e-7)
    # The peer is stopped down otherwise; its pupils' ratio is the lens's own.
    ratio = peer["exit_diameter"] / peer["entrance_diameter"]
    assert numbers.exit_radius / numbers.entrance_radius == pytest.approx(ratio, rel=1e-7)
    assert numbers.focal_length / peer["entrance_diameter"] == pytest.approx(peer["f_number"], rel=1e-7)


@pytest.mark.parametrize("name", ["double_gauss", "cooke_triplet", "tessar"])
def test_rays_and_paths_are_optilands(name):
    require_the_peers(bundled_prescription(name), OPTILAND[name])


@pytest.mark.needs_extension("lensdesign")
@pytest.mark.parametrize("name", ["cooke_triplet.zmx", "double_gauss.seq", "asphere.zmx"])
def test_lens_files_are_read_as_optiland_reads_them(name):
    """Surfaces, glasses and units; the last file is in inches."""
    lens, peer = mp.read_prescription(RECORDS / name), OPTILAND[name]
    assert (len(lens.surfaces), lens.wavelength) == (peer["surfaces"], pytest.approx(peer["wavelength"]))
    for wavelength, indices in peer["indices"].items():
        assert lens.indices(float(wavelength)) == pytest.approx(indices, abs=1e-9)
    require_the_peers(lens, peer)
