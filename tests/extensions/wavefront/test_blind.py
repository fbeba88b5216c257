"""An unknown object and an unknown wavefront from one capture."""

import numpy as np
import pytest
from wavefront_cases import captured, telescope

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.fitting import PixelNoise
from mitsuba_plenoptic.wavefront import Zone, deconvolve_zones, digital_adaptive_optics

ACCURACY = 0.3


def test_terms_come_nearer_in_each_turn():
    camera, point = telescope(lenses=8, pixels=4, width=2.0), np.array([(0.0, 0.0, 1e9)])
    true = (0.0, 0.0, 0.0, 0.0, 0.25)
    image = captured(camera, point, 1e6, true)
    seen = digital_adaptive_optics(camera, image, [Zone(point)], modes=5, turns=1, accuracy=ACCURACY)
    assert len(seen.misfits) == 2
    assert seen.misfits[1] < 0.5 * seen.misfits[0]
    np.testing.assert_array_equal(seen.cameras[0].wavefront[:4], 0)
    assert abs(seen.cameras[0].wavefront[4] - 0.25) < 0.15


@pytest.mark.slow
def test_object_and_wavefront_are_found_together():
    camera = telescope(lenses=8, pixels=4, width=2.0)
    step = 1.5 * camera.mla_pitch / 500 * 1e9
    axis = step * np.arange(-1, 2)
    points = np.array([(x, y, 1e9) for y in axis for x in axis])
    lit = np.array([0, 5, 6])
    true = (0.0, 0.0, 0.0, 0.0, 0.25, -0.2)
    image = captured(camera, points[lit], 1e6, true)
    zones, common = [Zone(points)], {"accuracy": ACCURACY}
    seen = digital_adaptive_optics(camera, image, zones, modes=6, turns=4, **common)
    np.testing.assert_array_equal(seen.cameras[0].wavefront[:4], 0)
    error = np.linalg.norm(np.array(seen.cameras[0].wavefront) - true)
    assert error < 0.3 * np.linalg.norm(true)
    assert seen.misfits[-1] < 0.2 * seen.misfits[0]
    shares = {}
    for name, some in (
        ("before", [camera]),
        ("after", seen.cameras),
        ("true", [camera.replace(wavefront=true)]),
    ):
        found = deconvolve_zones(some, image, zones, iterations=50, **common)
        shares[name] = found.weights[0][lit].sum() / found.weights[0].sum()
    assert shares["before"] < shares["after"]
    assert shares["after"] == pytest.approx(shares["true"], abs=0.1)


def test_noise_of_another_kind_is_refused():
    camera = telescope()
    with pytest.raises(InputError, match="PixelNoise"):
        digital_adaptive_optics(camera, np.ones(camera.shape), [Zone([(0.0, 0.0, 1e9)])], noise=1.0)
    with pytest.raises(InputError, match="cameras: give one for each zone, in a list; there are 1"):
        deconvolve_zones([], np.ones(camera.shape), [Zone([(0.0, 0.0, 1e9)])], noise=PixelNoise(1.0))
    zone = Zone([(0.0, 0.0, 1e9)])
    with pytest.raises(InputError, match="cameras: give one for each zone"):
        deconvolve_zones(camera, np.ones(camera.shape), [zone])
    with pytest.raises(InputError, match=r"cameras: one of them records \(24, 24\), not the image's \(48, 48\)"):
        deconvolve_zones([camera, telescope(lenses=4)], np.ones(camera.shape), [zone, zone])


def test_zones_beside_the_detector_are_refused():
    camera = telescope()
    beside = Zone([(50 * camera.mla_pitch / 500 * 1e9, 0.0, 1e9)])
    with pytest.raises(InputError, match="zones: the detector records no light of zone 0"):
        digital_adaptive_optics(camera, np.ones(camera.shape), beside, modes=5, accuracy=ACCURACY)
