"""Flows: no divergence, displacements that are the integrals of velocities, and what is known of each in theory."""

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose
from refusals import refused, refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import particles as pt
from mitsuba_plenoptic.extensions.particles.flows import FLOWS
from mitsuba_plenoptic.extensions.particles.particles_command import _flow

CAMERA = mp.PlenopticCamera()
CENTRE = (0.1, -0.2, 240.0)
CASES = [
    pt.Uniform((1.0, -2.0, 3.0)),
    pt.Shear(rate=2.0, along="y", across="z", centre=CENTRE),
    pt.TaylorGreen(speed=3.0, length=1.5, axis="y", centre=CENTRE),
    pt.LambOseen(circulation=9.0, core=0.4, axis="x", centre=CENTRE),
    pt.HillVortex(speed=2.0, radius=1.1, axis="z", centre=CENTRE),
]
NAMES = [type(case).__name__ for case in CASES]


@pytest.fixture
def points():
    return np.random.default_rng(3).uniform(-1.5, 1.5, (60, 3)) + CENTRE


@pytest.mark.parametrize("flow", CASES, ids=NAMES)
def test_flows_are_free_of_divergence(flow, points):
    step, divergence = 1e-5, 0.0
    for axis in np.eye(3):
        change = flow.velocity(points + step * axis) - flow.velocity(points - step * axis)
        divergence = divergence + change @ axis / (2 * step)
    assert np.abs(divergence).max() < 1e-5


@pytest.mark.parametrize("flow", CASES, ids=NAMES)
def test_displacements_are_integrals_of_velocities(flow, points):
    # Runge and Kutta's classical steps, written here.
    time, steps, now = 0.6, 400, points.copy()
    h = time / steps
    for _ in range(steps):
        one = flow.velocity(now)
        two = flow.velocity(now + h / 2 * one)
        three = flow.velocity(now + h / 2 * two)
        now = now + h / 6 * (one + 2 * two + 2 * three + flow.velocity(now + h * three))
    assert_allclose(flow.advected(points, time), now, atol=3e-7)
    assert_allclose(flow.advected(flow.advected(points, time), -time), points, atol=1e-8)


def test_hills_vortex_is_continuous_and_keeps_its_stream_function(points):
    flow, centre = CASES[-1], np.array(CENTRE)
    away = (points - centre) / np.linalg.norm(points - centre, axis=1)[:, None] * flow.radius
    assert_allclose(flow.velocity(centre + away * (1 - 1e-9)), flow.velocity(centre + away * (1 + 1e-9)), atol=1e-6)
    # Nothing crosses the sphere, and the stream is -U far away.
    assert np.abs((flow.velocity(centre + away) * away).sum(1)).max() < 1e-12
    assert_allclose(flow.velocity(centre + 1e5 * away), np.broadcast_to([0, 0, -flow.speed], away.shape), atol=1e-9)

    def stream(places):
        x, y, z = (places - centre).T / flow.radius
        square, distance = x * x + y * y, np.sqrt(x * x + y * y + z * z)
        inner = 0.75 * square * (1 - distance**2)
        return np.where(distance < 1, inner, -0.5 * square * (1 - np.maximum(distance, 1) ** -3.0))

    assert_allclose(stream(flow.advected(points, 0.5)), stream(points), atol=1e-8)


def test_the_core_of_a_line_vortex_turns_as_a_rigid_body():
    flow = pt.LambOseen(circulation=9.0, core=0.4, axis="z", centre=(0, 0, 0))
    near, far = np.array([[1e-4, 0, 0]]), np.array([[40.0, 0, 0]])
    assert_allclose(flow.velocity(near)[0], [0, 9 / (2 * np.pi * 0.16) * 1e-4, 0], rtol=1e-6)
    assert_allclose(flow.velocity(far)[0], [0, 9 / (2 * np.pi * 40), 0], rtol=1e-12)


def test_a_field_in_a_file_is_followed_as_the_flow_it_was_sampled_from(tmp_path, points):
    flow = pt.Shear(rate=2.0, along="x", across="z", centre=CENTRE)
    axes = {name: np.linspace(-4, 4, 5) + middle for name, middle in zip("xyz", CENTRE, strict=True)}
    nodes = np.stack(np.meshgrid(*axes.values(), indexing="ij"), -1)
    velocity = flow.velocity(nodes.reshape(-1, 3)).reshape(nodes.shape)
    parts = {name: (("x", "y", "z"), velocity[..., index]) for index, name in enumerate("uvw")}
    xr.Dataset(parts, axes).transpose("z", "y", "x").to_netcdf(tmp_path / "field.nc")
    assert (pt.ImportedFlow(still()).velocity(np.full((1, 3), 0.5)) == 0).all()
    imported = pt.ImportedFlow(tmp_path / "field.nc")
    # Linear interpolation is exact for a linear field.
    assert_allclose(imported.advected(points, 0.3), flow.advected(points, 0.3), atol=1e-9)
    refuses(r"a particle at .* leaves its grid, -3.9 to 4.1, .* mm", imported.advected, points, 30.0)
    # Particles that gather in a plane: exp(0.47) = 1.6 times as many from frame to frame.
    box = pt.ParticleVolume(tuple(np.array(CENTRE) - 2), tuple(np.array(CENTRE) + 2))
    sink = xr.Dataset(parts | {"u": (("x", "y", "z"), -4.7 * (nodes[..., 0] - CENTRE[0]))}, axes)
    with pytest.warns(UserWarning, match="flow: by its divergence the density of particles changes by 47% or more"):
        pt.particle_sequence(CAMERA, box, pt.Seeding(count=9), pt.ImportedFlow(sink), interval=0.1)


test_bad_flows_are_refused_in_one_line = refused(
    (lambda: pt.Shear(along="x", across="x"), "along = x, across = x"),
    (lambda: pt.Uniform((1, 2)), r"speed = \(1, 2\)"),
    (lambda: pt.ImportedFlow(still(v="m/s")), "field: v is in m/s"),
    (lambda: pt.ImportedFlow(still(z="m")), "field: z is in m"),
    (lambda: _flow("lamb_oseen:radius=2", FLOWS, (0, 0, 240)), "radius: .*core"),
    (lambda: pt.ImportedFlow(__file__), "test_flows.py"),
)


def still(**units):
    parts = {part: (tuple("xyz"), np.zeros((2, 2, 2)), {"units": units.get(part, "mm s-1")}) for part in "uvw"}
    return xr.Dataset(parts, {axis: (axis, [0.0, 1.0], {"units": units.get(axis, "mm")}) for axis in "xyz"})
