"""Single particles, and the mark of tests whose particles scatter light."""

from importlib.util import find_spec

import numpy as np
import pytest

from mitsuba_plenoptic import particles as pt

needs_miepython = pytest.mark.skipif(find_spec("miepython") is None, reason="spheres scatter light by miepython")


def one_particle(place, camera, diameter=1.0, direction=(1.0, 0.0, 0.0), **seeding):
    box = pt.ParticleVolume(tuple(np.array(place) - 0.1), tuple(np.array(place) + 0.1))
    still, given, light = pt.Uniform((0.0, 0.0, 0.0)), pt.Seeding(count=8, **seeding), pt.LightSheet(direction)
    truth = pt.particle_sequence(camera, box, given, still, interval=1, frames=1, sheet=light, seed=4)
    truth = truth.isel(particle=[0])
    truth["position"][:], truth["diameter"][:] = np.array(place), diameter
    return truth
