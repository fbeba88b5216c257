"""Derivatives of captures by signed rays by the camera, against captures whose rays are held in the scene."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.ndimage
import scipy.signal
from cases import facing, radiating, scene_of

from mitsuba_plenoptic import Job, PlenopticCamera
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.rays.tracer import Walk
from mitsuba_plenoptic.runtime.batches import Box, SumTask
from mitsuba_plenoptic.waves import signed_rays
from mitsuba_plenoptic.waves.phase_space import PhaseSpace, WaveAccuracy, coefficients_of
from mitsuba_plenoptic.waves.ray_sampler import Pixels
from mitsuba_plenoptic.waves.signed_camera import (
    PARAMETERS,
    CameraAdjoint,
    CameraTangents,
    follow_fixed,
    parameters_of,
    varying_parameters,
)
from mitsuba_plenoptic.waves.spectral_nodes import Node

PIXELS = 192
SIZE = {"detector_width": 6 * 0.064, "resolution": (PIXELS, PIXELS)}
IDEAL = PlenopticCamera(**SIZE)
MODELS = {
    "ideal": IDEAL,
    "parabolic in a medium": PlenopticCamera(mla_medium=1.5, mla_focal_length=0.768, lens_model="parabolic", **SIZE),
}
STEPS = {"focal_length": 0.01, "mla_distance": 0.01, "mla_focal_length": 5e-4, "mla_pitch": 2e-5, "mla_offset": 2e-4}


def light(point, slope, active, seed):
    """Return a radiance that differs smoothly over a card and over the pupil."""
    x, y = (p + 250 * t for p, t in zip(point[:2], slope, strict=True))
    return [dr.select(active, (0.6 + 0.3 * dr.sin(8 * x + 1) * dr.cos(7 * y)) * (1 + 0.05 * point[0]), 0)]


def weights():
    """Return a smooth figure: what pixels count."""
    y, x = np.mgrid[:PIXELS, :PIXELS] - PIXELS / 2
    return np.exp(-((x - 6) ** 2 + (y - 9) ** 2) / (2 * 16**2))


def moved(camera, name, amount):
    start = parameters_of(camera)[name]
    start[0] += amount
    return camera.replace(**{name: start.tolist() if len(start) > 1 else float(start[0])})


def traced(work, pixels, key):
    """Return the rays that a sum draws, and their slopes in the scene."""
    samples = work.samples(pixels, key)
    walk = Walk.of(work._camera, OpticalSystem(work._camera, 633.0).lens)
    return samples, walk.through_pupil(samples.ray.P, samples.ray.m, samples.lens.height)[1]


class HeldRays(CameraTangents):
    """The figure that held rays make in another camera, each where it lands there."""

    def figure(self, camera):
        plan = self._nodes[0].plan
        self.other, self.table, self.total = camera, coefficients_of([plan.moved(camera)])[0], 0.0
        samples = plan.waves.kernel_samples(self._step, plan.moved(camera).reach)
        step = self._step * camera.detector_width / self._camera.detector_width
        kernels = plan.moved(camera).sampled_kernels(step, samples, 0) / self._sampler.enlargements[0] ** 2
        self.margin = PIXELS // 2
        figure = np.pad(weights(), self.margin)
        frequencies = np.fft.fftfreq(len(figure))
        # Points about a cell are drawn with a linear B-spline's density.
        sharp = np.fft.ifft2(np.fft.fft2(figure) / np.sinc(frequencies)[:, None] / np.sinc(frequencies)).real
        self.felt_by = [scipy.signal.fftconvolve(sharp, kernel[::-1, ::-1], "same") for kernel in kernels]
        for _ in self.batches(0):
            pass
        return self.total

    def estimate(self, batch):
        drawn, direction = traced(self, batch.pixels, batch.key)
        index, box = dr.gather(mi.UInt32, batch.pixels.index, drawn.pixel), batch.pixels.box
        valid, node = drawn.ray.valid, self._nodes[0]
        walk = Walk.of(self._camera, OpticalSystem(self._camera, 633.0).lens)
        start, _, _ = walk.through_pupil(drawn.ray.P, drawn.ray.m, drawn.lens.height)
        (radiance,) = light(start, direction, valid, 0)
        # Rays of even numbers subtract the mean of those of odd numbers, and vice versa.
        ones = dr.select(valid, mi.Float(1), 0)
        halves = [np.asarray(value, float).reshape(-1, self._spp // 2, 2) for value in (radiance, ones)]
        mean = (halves[0].sum(1) / np.maximum(halves[1].sum(1), 1))[:, None, ::-1]
        mean = mi.Float(np.broadcast_to(mean, halves[0].shape).ravel().astype(np.float32))
        mean = dr.select(valid, mean, 0)
        strength = dr.select(valid, (radiance - mean) * drawn.ray.weight, 0)
        here, there = (
            follow_fixed(self._camera, varying_parameters(camera), drawn, direction, self._step)
            for camera in (self._camera, self.other)
        )
        scale = self.other.mla_pitch / self._camera.mla_pitch
        point = tuple(p * scale for p in there.point)
        same = all(bool(dr.all(a == b)) for a, b in zip(here.point, there.point, strict=True))
        # Where points do not move, the same nodes of the table have the same noise.
        values = self.table(point, drawn.round_pupil, drawn.chance, valid) if same else self.interpolated(point, drawn)
        count = np.asarray(strength * dr.exp(there.measure - here.measure), float)
        values = [np.asarray(value, float) * count for value in values]
        values[0] += np.asarray(mean * dr.exp(there.density - here.density), float)
        # Light meets the lenses of the other camera in another direction.
        oblique = node.plan.oblique
        if oblique.count:
            bent = oblique.terms(np.array([np.asarray(cosine) for cosine in there.cosines]))
            values += list(np.einsum("rnk,kx,nx->rx", oblique.factors, bent, np.array(values)))
        whole = np.divmod(np.asarray(index, float), box.columns)
        ends = zip(whole, (box.top, box.left), here.cell[::-1], there.cell[::-1], strict=True)
        place = [at + first + self.margin + np.asarray(after - before, float) for at, first, before, after in ends]
        for value, felt in zip(values, self.felt_by, strict=True):
            self.total += np.vdot(value, scipy.ndimage.map_coordinates(felt, place, order=5)) / self._spp
        return [None for _ in self._nodes]

    def interpolated(self, point, drawn):
        _, radial = self.table._nodes.along(*drawn.round_pupil, drawn.chance[0])
        shares = []
        for axis in (1, 0):
            count = mi.Float(dr.gather(mi.Int, self.table._counts[axis], radial))
            place = dr.select(drawn.round_pupil[axis] < 0, -point[axis], point[axis])
            place = place * count / dr.gather(mi.Float, self.table._sides[axis], radial) + count / 2 - 0.5
            shares.append(place - dr.floor(place))
        total = [mi.Float(0)] * self._nodes[0].plan.functions.count
        for i, j in np.ndindex(2, 2):
            share = (shares[0] if i else 1 - shares[0]) * (shares[1] if j else 1 - shares[1])
            found = self.table(point, drawn.round_pupil, (*drawn.chance[:2], mi.Float(i), mi.Float(j)), drawn.ray.valid)
            total = [before + share * value for before, value in zip(total, found, strict=True)]
        return total


@pytest.fixture(scope="module", params=MODELS.values(), ids=MODELS.keys())
def node(request):
    return Node(PhaseSpace.of(request.param, 633.0, WaveAccuracy(degree=2)), (0,), np.ones((1, 1)))


def image(work):
    items, shape = int(work.items.sum()), (*work._camera.shape, 1)
    return Job().run([SumTask(items, lambda: work, lambda image: image)], shape, items)[..., 0]


def unit(name):
    return np.eye(len(parameters_of(IDEAL)[name]))[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", PARAMETERS)
def test_against_differences_of_held_rays(node, name):
    options = {"parts": 1, "spp": 64, "seed": 3, "changes": {name: unit(name)}}
    with dr.suspend_grad():
        camera = node.plan.camera
        found = np.vdot(image(CameraTangents(camera, light, [node], **options)), weights())
        held, step = HeldRays(camera, light, [node], **options), STEPS.get(name, 1e-4)
        sides = [held.figure(moved(camera, name, side)) for side in (step, -step)]
    expected = (sides[0] - sides[1]) / (2 * step)
    # Where points move, rays that leave a window of the table make differences noisy, up to 4 % with these steps.
    moves = name in ("focal_length", "mla_distance", "mla_pitch", "mla_offset")
    # By the detector's width, what moves and what grows cancel to a hundredth.
    assert found == pytest.approx(expected, rel=0.05 if moves else 0.015, abs=1.0 if name == "detector_width" else None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("array", "changes"),
    [
        (
            {"mla_lattice": "hexagonal", "mla_focal_length": (0.48, 0.512, 0.55)},
            {"mla_focal_length": np.array([0.1, -0.2, 0.3])},
        ),
        ({}, {"focal_length": np.ones(1), "mla_distance": np.ones(1), "mla_offset": np.array([0.01, -0.02])}),
    ],
    ids=["three focal lengths", "several"],
)
def test_reverse_is_the_transpose_of_forward(array, changes, monkeypatch):
    # Rays are traced in several batches.
    monkeypatch.setattr(signed_rays, "_LANES", 2**10)
    generator = np.random.default_rng(1)
    camera = PlenopticCamera(detector_width=2 * 0.064, resolution=(16, 16), **array)
    plans = [PhaseSpace.of(camera, wavelength, WaveAccuracy(1, 3, radial=4)) for wavelength in (500.0, 633.0)]
    # Two nodes of light of two values.
    nodes = [Node(plan, (0, 1), weights) for plan, weights in zip(plans, generator.normal(size=(2, 2, 2)), strict=True)]
    gradient = generator.normal(size=(16, 16, 2)).astype(np.float32)
    options = {"parts": 2, "spp": 4, "seed": 5}

    def two_values(*ray):
        (value,) = light(*ray)
        return [value, 0.3 + dr.square(value)]

    with dr.suspend_grad():
        work = CameraTangents(camera, two_values, nodes, **options, changes=changes)
        items = int(work.items.sum())
        change = Job().run([SumTask(items, lambda: work, lambda image: image)], (16, 16, 2), items)
        adjoint = CameraAdjoint(camera, two_values, nodes, **options, names=tuple(changes))
        found = adjoint.backward(np.moveaxis(gradient, -1, 0))
    back = sum(part @ changes[name] for name, part in found.items())
    assert abs(np.vdot(change, gradient) - back) < 1e-6 * np.linalg.norm(change) * np.linalg.norm(gradient)


def test_rays_come_back_to_where_they_were_drawn(node):
    camera = node.plan.camera
    work = CameraTangents(camera, light, [node], parts=1, spp=8, seed=3, changes={})
    step = camera.pixel_size
    nearest = work._sampler.choice.lenses.index((0, 0))
    pixels = Pixels(Box(0, 0, PIXELS, PIXELS), mi.UInt32(50, 1000, 30000), mi.UInt32(nearest))
    drawn, direction = traced(work, pixels, mi.UInt32(16))
    held = follow_fixed(camera, varying_parameters(camera), drawn, direction, step)
    for found, expected in zip(held.point, drawn.lens_point, strict=True):
        np.testing.assert_allclose(found, expected, atol=2e-5)
    index = np.array([50, 1000, 30000]).repeat(dr.width(drawn.number) // 3)
    for found, whole in zip(held.cell, (index % PIXELS, index // PIXELS), strict=True):
        # A linear B-spline reaches as far as a cell.
        assert np.all(np.abs(np.asarray(found) + PIXELS / 2 - whole - 0.5) <= 1 + 1e-3)


@pytest.mark.slow
def test_gradients_by_another_parameter_before_change_nothing():
    """Plans of one camera that are expanded about different ones are kept apart."""
    mi.set_variant("llvm_ad_mono")
    camera = PlenopticCamera(detector_width=0.064, resolution=(8, 8))
    texels = np.random.default_rng(0).uniform(0, 1, (8, 8, 1)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    slopes = {}
    for name, mode in (("mla_distance", "backward"), ("mla_pitch", "backward"), ("mla_pitch", "forward")):
        scene = scene_of(camera.to_sensor(), "plenoptic_wave", card=facing(232.0, 1.0, **radiating(texture)))
        params = mi.traverse(scene)
        x = mi.Float(0.0)
        dr.enable_grad(x)
        params[f"camera.{name}"] += x
        params.update()
        if mode == "forward":
            dr.forward(x, dr.ADFlag.ClearEdges)
        total = dr.sum(mi.render(scene, params, spp=16, seed=5), axis=None)
        if mode == "forward":
            slopes[mode] = float(dr.forward_to(total).array[0])
        else:
            dr.backward(total)
            slopes[mode] = float(dr.grad(x)[0])
    assert slopes["forward"] == pytest.approx(slopes["backward"], rel=1e-3)
