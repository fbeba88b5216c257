"""Links of fields against sums in double precision by NumPy alone, their adjoints, and a coherent sum through all."""

import drjit as dr
import numpy as np
import pytest
from cameras import error
from scipy.special import fresnel

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic.fields.elements import Element
from mitsuba_plenoptic.fields.links import Chain, FreeSpace, Fresnel, FromSpectrum, Hop, Spectrum
from mitsuba_plenoptic.fields.steps import AxisStep, Directions, LensAxis, Step
from mitsuba_plenoptic.fields.workspace import FieldWorkspace
from mitsuba_plenoptic.optics.waves import phasor

WAVELENGTH = 633.0
LAM = WAVELENGTH * 1e-6
PITCH = 2e-3


def single(values):
    return dr.float32_array_t(type(values))(values)


STEPS = {
    "same samples": (20, 64, 64, 0.0, 64),
    "cut and moved": (33, 81, 81, 0.0113, 50),
    "finer": (30, 60, 135, -0.007, 100),
    "coarser": (70, 150, 64, 0.031, 40),
}
"""Source samples, those of both windows, the offset of the first wanted sample, and how many are wanted."""

SPACES = {
    "cosines": FreeSpace(0.7, WAVELENGTH),
    "slopes": FreeSpace(0.7, WAVELENGTH, paraxial=True),
    "the rest": FreeSpace(30.0, WAVELENGTH, beyond_paraxial=True),
    "seen by pixels": FreeSpace(-0.7, WAVELENGTH, response=lambda sx, sy: single(1 - 4 * (sx * sx + 2 * sy * sy))),
}


def step_of(name, other="cut and moved"):
    def axis(first, count, padded, new_padded, moved, wanted):
        return AxisStep(first, PITCH, count, padded, new_padded, first + moved, wanted)

    return Step(axis(-0.021, *STEPS[name]), axis(0.013, *STEPS[other]))


def lens(x, y):
    waves = (x * x + 2 * y * y) / 1e-3 + 17 * x
    if isinstance(x, np.ndarray):
        return np.exp(2j * np.pi * waves) * (x > -0.01)
    return dr.select(x > -0.01, phasor(waves), 0)


def random(*shape, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)


def result(link, field, shape, adjoint=False):
    steps = link.steps if isinstance(link, Chain) else [link.step]
    workspace = FieldWorkspace([*steps, *(step.reversed for step in steps)])
    blocks = workspace.blocks(field.copy())
    return workspace.whole((link.adjoint if adjoint else link.forward)(blocks, workspace), shape)


def frequencies(axis):
    held = min(axis.padded, axis.new_padded)
    return np.fft.fftfreq(held, 1 / held) / (axis.padded * axis.pitch)


def to_frequencies(axis):
    return np.exp(-2j * np.pi * np.outer(frequencies(axis), axis.pitch * np.arange(axis.count))) / axis.padded


def to_samples(axis):
    places = axis.start - axis.first + axis.padded * axis.pitch / axis.new_padded * np.arange(axis.wanted)
    return np.exp(2j * np.pi * np.outer(places, frequencies(axis)))


def transfer(space, step):
    sx, sy = LAM * frequencies(step.x), LAM * frequencies(step.y)[:, None]
    square = sx**2 + sy**2
    exact = np.exp(2j * np.pi * space.distance / LAM * (np.sqrt(1 - square) - 1))
    paraxial = np.exp(-1j * np.pi * space.distance / LAM * square)
    factor = exact / paraxial if space.beyond_paraxial else paraxial if space.paraxial else exact
    # Half a period a sample stands for both of its signs, and is left out.
    factor *= np.outer(*(2 * axis.padded * axis.pitch * frequencies(axis) > -axis.held for axis in (step.y, step.x)))
    return factor * (1 - 4 * (2 * sx**2 + sy**2) if space.response else 1)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", STEPS)
def test_a_hop_is_a_sum_of_plane_waves(name, space):
    step, space = step_of(name), SPACES[space]
    field = random(step.y.count, step.x.count)
    behind = field * lens(step.x.source, step.y.source[:, None])
    spectrum = to_frequencies(step.y) @ behind @ to_frequencies(step.x).T * transfer(space, step)
    expected = to_samples(step.y) @ spectrum @ to_samples(step.x).T
    assert error(result(Hop(step, space, Element(step, lens)), field, step.shape), expected) < 2e-6


def test_one_transform_is_fresnels_integral():
    x, y = (AxisStep(first, PITCH, count, 90, 61, first, count) for first, count in ((-0.04, 41), (-0.03, 36)))
    step, distance = Directions(x, y), 2.0
    onto = tuple(LensAxis(61, LAM * distance / (90 * PITCH)) for _ in "xy")
    field = random(y.count, x.count)
    # The constant phase of the integral is left out.
    sums = [
        np.exp(1j * np.pi * (axis.source - there[:, None]) ** 2 / (LAM * distance)) * PITCH / np.sqrt(LAM * distance)
        for axis, there in ((x, onto[0].samples), (y, onto[1].samples))
    ]
    expected = sums[0] @ field.T @ sums[1].T
    assert error(result(Fresnel(step, onto, distance, WAVELENGTH), field, (61, 61)), expected) < 2e-6


def links():
    """Return links beside hops, whose adjoint a relation judges."""
    for name in ("cut and moved", "coarser"):
        step = step_of(name, "finer")
        held = step.x.held, step.y.held
        source, there = (step.y.count, step.x.count), step.shape
        separated = Element.separated(step, lambda x, y: phasor(30 * x * x - 20 * y), (0.0, 0.0))
        yield f"{name}, lines", Hop(step, SPACES["cosines"], separated), source, there
        yield f"{name}, directions", Spectrum(step, Element(step, lens)), source, held
        yield f"{name}, from directions", FromSpectrum(step, lambda watch: None), held, there
        after = Step(*(AxisStep(a.start, a.new_pitch, a.wanted, 128, 128, a.start, 30) for a in (step.x, step.y)))
        yield f"{name}, chain", Chain([Hop(step, SPACES["cosines"]), Hop(after, SPACES["slopes"])]), source, (30, 30)
    axis = AxisStep(-0.04, PITCH, 41, 90, 61, -0.04, 41)
    onto = LensAxis(61, LAM * 2.0 / (90 * PITCH))
    yield "fresnel", Fresnel(Directions(axis, axis), (onto, onto), 2.0, WAVELENGTH), (41, 41), (61, 61)


@pytest.mark.parametrize(("link", "source", "there"), [pytest.param(*rest, id=name) for name, *rest in links()])
def test_adjoints(link, source, there):
    x, y = random(*source), random(*there, seed=1)
    forward, adjoint = result(link, x, there), result(link, y, source, adjoint=True)
    assert abs(np.vdot(y, forward) - np.vdot(adjoint, x)) < 1e-6 * np.linalg.norm(forward) * np.linalg.norm(y)


CAMERA = PlenopticCamera(
    focal_length=5, aperture_radius=0.3125, focus_distance=15, mla_pitch=0.016, mla_focal_length=0.128,
    detector_width=0.064, resolution=(40, 40),
)  # fmt: skip
"""The paper's angles at a sixteenth of its size, with microlenses of 25 wavelengths."""

FINER = 2
"""Samples across a pixel."""


def plain_angular_spectrum(field, pitch, distance):
    s = [LAM * np.fft.fftfreq(count, pitch) for count in field.shape]
    square = s[0][:, None] ** 2 + s[1] ** 2
    kz = np.sqrt(np.maximum(1 - square, 0))
    factor = np.where(square < 1, np.exp(2j * np.pi * distance / LAM * (kz - 1)), 0)
    return np.fft.ifft2(np.fft.fft2(field) * factor)


def plain_microlenses(places, camera, pitch, steepest):
    """Sum of the orders that the samples hold, each by the integral over a lens in closed form."""
    D, f = camera.mla_pitch, camera.mla_focal_length
    highest = int((LAM / (2 * pitch) - steepest) * D / LAM)
    q = np.arange(-highest, highest + 1)
    area = LAM * f / D**2
    sines, cosines = fresnel((area * q[:, None] + np.array([0.5, -0.5])) * np.sqrt(2 / area))
    integral = (cosines[:, 0] - cosines[:, 1] - 1j * (sines[:, 0] - sines[:, 1])) * np.sqrt(area / 2)
    orders = integral * np.exp(1j * np.pi * area * q.astype(float) ** 2)
    return np.exp(2j * np.pi * np.outer(places / D - 0.5, q)) @ orders


def plain_field(camera, point, pitch, count):
    """A point's field on the detector, on a window of its own width, by NumPy in double precision."""
    X, Y, g = point
    radius = camera.aperture_radius
    place = (np.arange(count) - count / 2 + 0.5) * pitch
    x, y = place, place[:, None]
    d = 1 / (1 / camera.focal_length - 1 / g)
    mx, my = -X * d / g, -Y * d / g
    amplitude = g / ((x - X) ** 2 + (y - Y) ** 2 + g**2)
    inside = np.hypot(x, y) < radius
    cover = np.clip((radius - np.hypot(x, y)) / pitch + 0.5, 0, 1)
    path = np.sqrt(mx**2 + my**2 + d**2) - np.sqrt((x - mx) ** 2 + (y - my) ** 2 + d**2)
    pupil = amplitude * cover * np.exp(2j * np.pi * path / LAM) / np.sqrt((amplitude**2 * inside).sum() * pitch**2)
    array = plain_angular_spectrum(pupil, pitch, camera.mla_distance)
    size = round(1.5 * camera.detector_width / pitch / 2) * 2
    middle = slice(count // 2 - size // 2, count // 2 + size // 2)
    line = plain_microlenses(place[middle], camera, pitch, (radius + camera.detector_width / 2) / camera.mla_distance)
    return plain_angular_spectrum(array[middle, middle] * line * line[:, None], pitch, camera.detector_distance)


def plain_pixels(field, camera, pitch):
    """Integrals over pixels of the intensity, which has twice the frequencies of the field."""
    size = len(field)
    wide = np.zeros((2 * size, 2 * size), complex)
    order = np.rint(np.fft.fftfreq(size) * size).astype(int)
    wide[np.ix_(order, order)] = np.fft.fft2(field)
    spectrum = np.fft.fft2(abs(4 * np.fft.ifft2(wide)) ** 2)
    columns = camera.resolution[0]
    edges = (np.arange(columns) + 0.5 - columns / 2) * camera.pixel_size - (-size / 2 + 0.5) * pitch
    f = np.fft.fftfreq(2 * size, pitch / 2)
    means = np.exp(2j * np.pi * np.outer(edges, f)) * np.sinc(f * camera.pixel_size) / (2 * size)
    return (means @ spectrum @ means.T).real * camera.pixel_size**2


POINTS = [(0.01, -0.02, 15.0), (-0.03, 0.02, 14.0)]


def plain(amplitudes):
    pitch = CAMERA.pixel_size / FINER
    fields = [a * plain_field(CAMERA, point, pitch, 1500) for a, point in zip(amplitudes, POINTS, strict=True)]
    return plain_pixels(sum(fields), CAMERA, pitch)


@pytest.mark.needs_extension("laser")
def test_a_coherent_sum_is_that_of_plain_numpy():
    fields = CaptureOperator(CAMERA, POINTS, wavelength=WAVELENGTH, method="full_field").coherent_fields
    assert error(fields.intensity(np.array([1, 0.8j], np.complex64)), plain([1, 0.8j])) < 3e-3
