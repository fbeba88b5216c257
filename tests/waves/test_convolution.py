"""Convolutions of the images of rays: in one go, in tiles, in bands, and back."""

import numpy as np
import pytest
import scipy
from cameras import small_camera

from mitsuba_plenoptic.runtime.batches import Box, Part, add
from mitsuba_plenoptic.waves.convolution import Convolution


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
