"""Refocusing by slices of a light field's four-dimensional spectrum."""

from __future__ import annotations

import math

import numpy as np
import scipy
import xarray as xr

from ..errors import InputError, require_number
from ..runtime.limits import require_memory
from .geometry import require_light_field, view_steps
from .views import as_view

# Gridding kernel: a Kaiser-Bessel window this many samples wide on a grid with twice as many samples as views.
_WIDTH = 6
_OVERSAMPLING = 2
# P. J. Beatty et al., "Rapid gridding reconstruction with a minimal oversampling ratio" (2005), equation 5.
_BETA = math.pi * math.sqrt((_WIDTH / _OVERSAMPLING) ** 2 * (_OVERSAMPLING - 0.5) ** 2 - 0.8)


class FourierRefocuser:
    r"""Refocus by the Fourier slice photography theorem: a photograph's spectrum is a slice of the light field's.

    After R. Ng, "Fourier Slice Photography" (2005). With :math:`\hat L` the spectrum of the light field, the
    photograph refocused to disparity :math:`\delta` has the spectrum
    :math:`\hat E(k_t, k_s) = \hat L(-\delta k_t, -\delta k_s, k_t, k_s)`. The spectrum is computed once; a photograph
    then takes one two-dimensional interpolation over (v, u) and one inverse FFT. Views are moved by exact Fourier
    interpolation, so that photographs are a little sharper than by `shift_and_add`.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field, (v, u, t, s[, c]).
    max_disparity : float
        Largest magnitude of disparity that will be asked for, in lenses per view; the borders are continued by as
        much as views move.

    Raises
    ------
    InputError
        If the disparity is not a number, or the spectrum would not fit: four times as many complex numbers as the
        light field has samples.
    """

    def __init__(self, lf: xr.DataArray, max_disparity: float) -> None:
        self._lf = require_light_field(lf)
        max_disparity = abs(require_number("max_disparity", max_disparity, minimum=-1e6, maximum=1e6))
        self._steps = view_steps(lf, "v"), view_steps(lf, "u")
        self._margin = math.ceil(max_disparity * max(np.abs(steps).max() for steps in self._steps)) + 1
        self._max_disparity = max_disparity
        views, field = lf.shape[:2], lf.shape[2:4]
        self._grid = tuple(scipy.fft.next_fast_len(max(_WIDTH, _OVERSAMPLING * n)) for n in views)
        self._field = tuple(scipy.fft.next_fast_len(n + 2 * self._margin, real=True) for n in field)
        size = self._grid[0] * self._grid[1] * self._field[0] * (self._field[1] // 2 + 1) * (3 if lf.ndim == 5 else 1)
        # The spectrum before and after its last transform.
        require_memory(16.0 * size, f"spectrum of a light field of shape {lf.shape}", lambda _: "method 'shift'")
        # Views count by the mean fraction of the pupil that they see.
        weight = np.asarray(lf["weight"].values).mean(axis=(2, 3))
        weight = weight / max(weight.sum(), np.finfo(np.float32).tiny)
        values = np.asarray(lf.values) if lf.ndim == 5 else np.asarray(lf.values)[..., None]
        self._spectra = [self._spectrum(values[..., channel], weight) for channel in range(values.shape[-1])]

    def _spectrum(self, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Transform one channel, prepared for interpolation, to (grid v, grid u, field t, half field s)."""
        scale = [1 / _kernel_transform(np.arange(n) - n // 2, m) for n, m in zip(weight.shape, self._grid, strict=True)]
        prepared = values * (weight * scale[0][:, None] * scale[1])[:, :, None, None].astype(np.float32)
        before = self._margin
        after = [total - before - size for total, size in zip(self._field, values.shape[2:], strict=True)]
        prepared = np.pad(prepared, ((0, 0), (0, 0), (before, after[0]), (before, after[1])), mode="edge")
        spectrum = scipy.fft.rfft2(prepared, axes=(2, 3))
        # The middle view goes to index 0, so that phases vary slowly.
        padded = np.zeros((*self._grid, *spectrum.shape[2:]), dtype=np.complex64)
        rows, columns = ((np.arange(n) - n // 2) % m for n, m in zip(weight.shape, self._grid, strict=True))
        padded[np.ix_(rows, columns)] = spectrum
        return scipy.fft.fft2(padded, axes=(0, 1), overwrite_x=True)

    def refocus(self, disparity: float) -> xr.DataArray:
        """Return the photograph refocused to a disparity.

        Parameters
        ----------
        disparity : float
            Lenses that a point in focus moves from view to view; at most `max_disparity` in magnitude.

        Returns
        -------
        xarray.DataArray
            Dimensions t, s[, c].

        Raises
        ------
        InputError
            If the disparity is larger than prepared for.
        """
        if abs(disparity) > self._max_disparity * (1 + 1e-9):
            raise InputError(f"disparity = {disparity:g}: this refocuser was made for at most {self._max_disparity:g}")
        t = scipy.fft.fftfreq(self._field[0])
        s = scipy.fft.rfftfreq(self._field[1])
        # exp(+2 pi i k delta step) for each view is the slice at minus delta k; the first view's place, whole or
        # half, and the index that was moved to 0 leave a phase.
        down, across = -disparity * t, -disparity * s
        rows, row_weights = _neighbours(down, self._grid[0])
        columns, column_weights = _neighbours(across, self._grid[1])
        offsets = [steps[0] + len(steps) // 2 for steps in self._steps]
        phase = np.exp(-2j * math.pi * (down * offsets[0])[:, None]) * np.exp(-2j * math.pi * across * offsets[1])
        images = []
        for spectrum in self._spectra:
            slice_ = np.zeros((t.size, s.size), dtype=np.complex128)
            row_index, column_index = np.arange(t.size)[:, None], np.arange(s.size)
            for j in range(_WIDTH):
                for i in range(_WIDTH):
                    part = spectrum[rows[:, j, None], columns[:, i], row_index, column_index]
                    slice_ += part * (row_weights[:, j, None] * column_weights[:, i])
            image = scipy.fft.irfft2(slice_ * phase, s=self._field)
            height, width = self._lf.shape[2:4]
            images.append(image[self._margin : self._margin + height, self._margin : self._margin + width])
        return as_view(self._lf, np.stack(images, axis=-1) if self._lf.ndim == 5 else images[0])


def _neighbours(frequency: np.ndarray, grid: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the grid samples about each frequency (in cycles per sample), and their weights, (frequencies, width)."""
    place = frequency * grid
    first = np.ceil(place - _WIDTH / 2).astype(np.int64)
    index = first[:, None] + np.arange(_WIDTH)
    inside = 1 - ((place[:, None] - index) * 2 / _WIDTH) ** 2
    return index % grid, np.i0(_BETA * np.sqrt(np.maximum(inside, 0))) / np.i0(_BETA)


def _kernel_transform(position: np.ndarray, grid: int) -> np.ndarray:
    """Fourier transform of the kernel at sample positions: what interpolation with it multiplies them by."""
    square = np.asarray(_BETA**2 - (math.pi * _WIDTH * position / grid) ** 2)
    # The window's transform changes from sinh to sin beyond its main lobe, which positions of views never reach.
    root = np.sqrt(square)
    return _WIDTH * np.sinh(root) / (root * np.i0(_BETA))
