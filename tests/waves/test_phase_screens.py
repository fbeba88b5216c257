"""Phase screens by signed rays, which follow their slopes where these vary little, and are refused elsewhere."""

import numpy as np
import pytest
from cameras import disk, error
from cases import scene_of

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lenses.thin import Wavefront
from mitsuba_plenoptic.optics import guards

PLACES = np.linspace(-5.2, 5.2, 105)
COMA = (0, 0, 0, 0, 0, 0.3, 0, 0.5)


def capture(**changes):
    scene = scene_of(
        mp.PlenopticCamera(resolution=(32, 32), detector_width=0.128, **changes).to_sensor(),
        lamp=disk([0.03, 0.02, 240.0], 0.1),
    )
    return mp.render_capture(scene, model="wave", wavelength=550.0, spp=8)


def cubic(waves):
    """A screen that rises by so many waves from the pupil's middle to its rim, by the cube of x."""
    return mp.PhaseScreen(np.tile(waves * (PLACES / 5) ** 3, (len(PLACES), 1)), 10.4)


def test_a_screen_of_zernike_terms_equals_the_terms():
    of_terms = mp.PhaseScreen(Wavefront(COMA, 5.0).path(*np.meshgrid(PLACES, PLACES)) / 633e-6, 10.4)
    screen, terms = capture(phase_screen=of_terms).image, capture(wavefront=COMA).image
    assert error(screen, terms) < 2e-3
    assert error(screen, capture().image) > 0.2


def test_the_guard_has_the_third_derivative():
    r"""Of points q apart along x the paths :math:`c x^3` differ by :math:`c q^3 / 4` more than by the slope."""
    found = capture(phase_screen=cubic(10)).metadata["guards"]["phase_screen"]
    along = 550e-6 * 120 / 0.064 * np.cos(np.pi * np.arange(360) / 360)
    phase = 2 * np.pi * 10 * 633 / 550 / 5**3 * along**3 / 4
    assert found == pytest.approx((1 - np.cos(phase)).mean(), rel=0.02)
    with pytest.warns(mp.PhysicsWarning, match="phase_screen"):
        capture(phase_screen=cubic(20))
    with pytest.raises(guards.PhysicsError, match="of the light"):
        capture(phase_screen=cubic(100))
