"""Convolutions of the images of rays: in one go, in tiles, in bands, and back."""

import numpy as np
import pytest
import scipy
from cameras import small_camera

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.runtime.batches import Box, Part, add
from mitsuba_plenoptic.waves.convolution import Convolution
from mitsuba_plenoptic.waves.oblique import Oblique, terms
from mitsuba_plenoptic.waves.pixel_kernels import PixelKernels


def test_convolution_in_tiles_its_bands_and_its_adjoint():
    camera = small_camera(crop_offset=(2, 3), crop_size=(200, 61)).replace(resolution=(512, 512))
    generator = np.random.default_rng(0)
    kernels = generator.random((2, 9, 9), dtype=np.float32)
    plain = Convolution(camera, kernels)
    images = generator.random((2, plain.box.rows, plain.box.columns), dtype=np.float32)
    m = 4
    whole = sum(scipy.signal.fftconvolve(image, kernel, "same") for image, kernel in zip(images, kernels, strict=True))
    expected = whole[m:-m, m:-m]
    assert plain.forward(images).shape == (61, 200)
    np.testing.assert_allclose(plain.forward(images), expected, rtol=1e-5)
    bands, box = Convolution(camera, kernels, size=(25, plain.box.columns)), plain.box
    total = np.zeros((1, 61, 200), np.float32)
    for top in range(0, box.rows, 25):
        rows = Box(box.left, box.top + top, box.columns, min(25, box.rows - top))
        reached = bands.reached(rows)
        part = bands.forward(images[:, top : top + rows.rows], rows, reached)
        assert part.shape == (reached.rows, 200) and reached.rows < 40
        add(Part(reached, part[None]), Box(0, 0, 200, 61), total)
    np.testing.assert_allclose(total[0], expected, rtol=1e-5)
    pixels = generator.random((61, 200), dtype=np.float32)
    back = sum(np.vdot(image.astype(float), part) for image, part in zip(images, plain.adjoint(pixels), strict=True))
    assert np.vdot(plain.forward(images).astype(float), pixels) == pytest.approx(back, rel=1e-5)
    # A part of the samples, and some beyond those that pixels feel.
    part = Box(box.left + 100, box.top - 7, box.columns - 60, 40)
    image = bands.adjoint(pixels, part)[0]
    assert image.shape == (40, part.columns)
    np.testing.assert_allclose(image[:7], 0, atol=1e-4)
    np.testing.assert_allclose(image[7:, :-40], plain.adjoint(pixels)[0][:33, 100:], atol=1e-4)


def test_few_lit_samples_are_sums_of_kernels():
    camera = PlenopticCamera.preset("flfm").replace(crop_offset=(7, 9), crop_size=(80, 60))
    generator = np.random.default_rng(2)
    direct = Convolution(camera, generator.random((3, 11, 11), dtype=np.float32))
    images = np.zeros((3, direct.box.rows, direct.box.columns), np.float32)
    images[:, [0, 5, 30, -1], [0, 44, 44, -1]] = generator.random((3, 4))
    light = direct.forward(images)
    assert "spectra" not in vars(direct)
    direct._may_be_direct = False
    np.testing.assert_allclose(light, direct.forward(images), atol=1e-5)


PARTS, HALF, LARGEST = 2, 6, 0.2
FUNCTIONS, COMBINATIONS, PIXELS = 3, 2, 5


def made(tolerance: float = 0.0) -> tuple[PixelKernels, np.ndarray, Oblique, np.ndarray]:
    """Return kernels of pixels, those of cells, the combinations and the steps between the directions of cells."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    spot = np.exp(-(x * x + y * y) / 6)
    kernels = np.stack([spot, x * spot, y * spot, x * y * spot, (x * x - y * y) * spot])
    factors, none = rng.normal(size=(COMBINATIONS, FUNCTIONS, 5)), np.zeros((COMBINATIONS, FUNCTIONS, 5))
    # Products with these terms are those with the orthonormal ones, too.
    oblique = Oblique(LARGEST, factors, none, np.eye(6) + np.tril(rng.uniform(-0.3, 0.3, (6, 6)), -1))
    steps = 0.1 * np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)])
    found = PixelKernels(kernels, oblique, PARTS, steps, 0, np.eye(len(kernels)), tolerance, keeps_light=True)
    return found, kernels, oblique, steps


def lit(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients of cells and direction cosines of pixels."""
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(PIXELS, PARTS**2, FUNCTIONS)).astype(np.float32),
        rng.uniform(-0.1, 0.1, (2, PIXELS)).astype(np.float32),
    )


def test_images_of_pixels_are_the_sums_of_those_of_their_cells():
    kernels, of_cells, oblique, steps = made()
    values, cosines = lit(2)
    found = np.einsum("nx,nij->xij", kernels.combined(values, oblique.terms(cosines)), kernels.kernels)
    reach = (found.shape[1] - 1) // 2
    for pixel in range(PIXELS):
        exact = np.zeros(2 * [PARTS * (2 * reach + 1)])
        for place, (row, column) in enumerate(np.ndindex(PARTS, PARTS)):
            bent = np.array(terms(*(cosines[:, pixel] / LARGEST + steps[place]), 2))
            own = values[pixel, place]
            parts = np.concatenate([own, oblique.factors @ bent @ own])
            top, left = (PARTS * reach + index - HALF for index in (row, column))
            exact[top : top + 2 * HALF + 1, left : left + 2 * HALF + 1] += np.tensordot(parts, of_cells, 1)
        summed = exact.reshape(2 * reach + 1, PARTS, 2 * reach + 1, PARTS).sum((1, 3))
        assert found[pixel] == pytest.approx(summed, abs=1e-4 * abs(summed).max())


def test_few_patterns_keep_the_light():
    """The light of each coefficient is that of its kernel, however few patterns there are."""
    kernels, of_cells, oblique, _ = made(tolerance=0.2)
    assert len(kernels.kernels) < len(made()[0].kernels)
    values, cosines = lit(5)
    values[:] = np.abs(values)
    light = np.tensordot(kernels.kernels.sum((1, 2)), kernels.combined(values, 0 * oblique.terms(cosines)), 1)
    # Without the terms of the pixel's centre, cells have those of the step from there.
    straight = np.einsum("xpn,n->x", values, of_cells[:FUNCTIONS].sum((1, 2)))
    assert of_cells[FUNCTIONS:].sum((1, 2)) == pytest.approx(0, abs=1e-9)
    assert light == pytest.approx(straight, rel=1e-4)


def test_the_adjoint_is_that_of_the_images():
    kernels, _, oblique, _ = made()
    values, cosines = lit(3)
    bent = oblique.terms(cosines)
    images = np.random.default_rng(4).normal(size=(len(kernels.kernels), PIXELS)).astype(np.float32)
    for forward, adjoint in ((kernels.combined, kernels.adjoint), (kernels.turned, kernels.turned_adjoint)):
        there, back = np.vdot(forward(values, bent), images), np.vdot(values, adjoint(images, bent))
        assert there == pytest.approx(back, rel=1e-4)
