"""Figures of designs against independent estimates, their gradients against differences, and the search."""

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, small_camera

from mitsuba_plenoptic import CaptureOperator, reconstruct
from mitsuba_plenoptic.optimisation import DepthInformation, RefocusedContrast, maximise

CAMERA = small_camera(4, **HALF, detector_distance=0.512, wavefront=(*(0.0,) * 10, 0.05))
POINT = [(0.03, 0.01, 116.0)]


def spherical(amount):
    return [0.0] * 10 + [amount]


def test_contrast_is_that_of_the_refocused_image():
    capture = CaptureOperator(CAMERA, POINT, wavelength=WAVELENGTH, accuracy=0.02).forward([1.0])
    bins = np.nan_to_num(reconstruct(capture, 116.0, camera=CAMERA, oversample=2).image)
    quarter = np.exp(-1j * np.pi / 2 * np.arange(8))  # half a period a bin of one lens, of which there are two
    expected = (abs((bins.sum(0) * quarter).sum()) + abs((bins.sum(1) * quarter).sum())) / 2 / bins.sum()
    assert RefocusedContrast(CAMERA, POINT, (0.5,), oversample=2).value(CAMERA) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("figure", "name", "step", "limit"),
    [
        # At this accuracy derivatives keep another part of the diffracted light than spreads.
        (RefocusedContrast(CAMERA, POINT, (0.5, 0.8)), "mla_focal_length", 2e-3, 0.06),
        (RefocusedContrast(CAMERA, POINT, (0.5, 0.8)), "wavefront", spherical(0.02), 0.06),
        (DepthInformation(POINT, 3000.0), "wavefront", spherical(0.02), 0.05),
    ],
)
def test_gradients_against_differences(figure, name, step, limit):
    value, gradient = figure.gradient(CAMERA, [name])
    assert value == pytest.approx(figure.value(CAMERA), rel=1e-6)
    ahead, back = (np.add(getattr(CAMERA, name), side * np.array(step)).tolist() for side in (1, -1))
    change = figure.value(CAMERA.replace(**{name: ahead})) - figure.value(CAMERA.replace(**{name: back}))
    assert np.vdot(gradient[name][: np.size(step)], step) == pytest.approx(change / 2, rel=limit)


@pytest.mark.slow
def test_deviation_of_depth_is_that_of_differences_refined():
    """Plain differences by X, Y and g of captures, of two steps each, from which Richardson's rule takes the error."""
    g, background = 240.0, 2.0
    camera, point = small_camera(4, aperture_radius=1.0), np.array([0.0004, 0.0001, 1.0]) * g

    def image(move):
        return CaptureOperator(camera, [point + move], wavelength=WAVELENGTH, accuracy=0.02).forward([1.0]).ravel()

    rows = [1e4 * image(0).astype(np.float64)]
    for axis, step in enumerate((6e-6 * g, 6e-6 * g, 1.5e-5 * g**2)):
        moves = np.outer([step, step / 2], np.eye(3)[axis])
        coarse, fine = (5e3 * (image(move).astype(np.float64) - image(-move)) / move[axis] for move in moves)
        rows.append((4 * fine - coarse) / 3)
    whitened = np.stack(rows) / np.sqrt(rows[0].clip(0) + background)
    stated = DepthInformation([point], 1e4, background=background).deviations(camera)[0]
    assert stated == pytest.approx(np.sqrt(np.linalg.inv(whitened @ whitened.T)[3, 3]), rel=3e-3)


def test_deviation_of_depth_far_away():
    """Vergence is told as well at any distance far beyond the focal length, and dg = -g^2 d(1/g)."""
    points = np.array([[0.0004, 0.0001, 1.0]]) * [[1e6], [1e8]]
    near, far = DepthInformation(points, 1e4).deviations(small_camera(4, aperture_radius=1.0))
    assert far == pytest.approx(1e4 * near, rel=2e-3)


class Hill:
    def value(self, camera):
        return self.gradient(camera, [])[0]

    def gradient(self, camera, names):
        f, c = camera.mla_focal_length - 0.47, np.array(camera.wavefront) - spherical(0.25)
        slopes = {"mla_focal_length": np.array([-2e2 * f]), "wavefront": np.pad(-2 * c, (0, 25))}
        return -1e2 * f**2 - float(c @ c), {name: slopes[name] for name in names}


def test_search_finds_the_top_of_a_hill_and_keeps_to_bounds():
    seen = []
    bounds = {"mla_focal_length": (0.4, 0.6), "wavefront.11": (-1.0, 0.1)}
    design = maximise(Hill(), CAMERA, bounds, progress=lambda tried, value, best: seen.append((value, best)))
    assert design.values["mla_focal_length"] == pytest.approx(0.47, abs=1e-4)
    assert design.values["wavefront.11"] == pytest.approx(0.1)
    assert design.camera.wavefront[:10] == (0.0,) * 10
    assert design.tried == len(seen) and design.figure == max(value for value, _ in seen)
    assert seen[-1][1] == design.camera
