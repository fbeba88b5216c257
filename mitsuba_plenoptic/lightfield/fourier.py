"""Refocusing by slices of a light field's four-dimensional spectrum."""

from __future__ import annotations

import math

import numpy as np
import scipy
import xarray as xr

from ..errors import refuse_if, require_number
from ..runtime.limits import require_memory
from .geometry import channel_planes, require_light_field, view_steps
from .views import as_view


class FourierRefocuser:
    r"""Refocus by the Fourier slice photography theorem: a photograph's spectrum is a slice of the light field's.

    After R. Ng, "Fourier Slice Photography" (2005). With :math:`\hat L` the spectrum of the light field, the
    photograph refocused to disparity :math:`\delta` has the spectrum
    :math:`\hat E(k_t, k_s) = \hat L(-\delta k_t, -\delta k_s, k_t, k_s)`. The views' spectra are computed once; a
    photograph then takes their sum over (v, u) with the phases of that slice, and one inverse FFT. Views are moved by
    exact Fourier interpolation, so that photographs are a little sharper than by `shift_and_add`.

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
        If the disparity is not a number, or the spectra would take more memory than is allowed.
    """

    def __init__(self, lf: xr.DataArray, max_disparity: float) -> None:
        self._lf = require_light_field(lf)
        max_disparity = abs(require_number("max_disparity", max_disparity, minimum=-1e6, maximum=1e6))
        self._steps = view_steps(lf, "v"), view_steps(lf, "u")
        self._margin = math.ceil(max_disparity * max(np.abs(steps).max() for steps in self._steps)) + 1
        self._max_disparity = max_disparity
        self._field = tuple(scipy.fft.next_fast_len(n + 2 * self._margin, real=True) for n in lf.shape[2:4])
        size = lf.shape[0] * lf.shape[1] * self._field[0] * (self._field[1] // 2 + 1) * lf.sizes.get("c", 1)
        # The spectra, and the views that they are made from.
        require_memory(16.0 * size, f"spectrum of a light field of shape {lf.shape}", lambda _: "method 'shift'")
        # Views count by the mean fraction of the pupil that they see.
        weight = np.asarray(lf["weight"].values).mean(axis=(2, 3), keepdims=True)
        weight = weight / max(weight.sum(), np.finfo(np.float32).tiny)
        after = [total - self._margin - size for total, size in zip(self._field, lf.shape[2:4], strict=True)]
        border = ((0, 0), (0, 0), (self._margin, after[0]), (self._margin, after[1]))
        self._spectra = [
            scipy.fft.rfft2(np.pad(plane * weight.astype(np.float32), border, mode="edge"))
            for plane in channel_planes(lf)
        ]

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
        refuse_if(
            abs(disparity) > self._max_disparity * (1 + 1e-9),
            f"disparity = {disparity:g}: this refocuser was made for at most {self._max_disparity:g}",
        )
        frequencies = scipy.fft.fftfreq(self._field[0]), scipy.fft.rfftfreq(self._field[1])
        down, across = (
            np.exp(2j * math.pi * disparity * np.outer(steps, frequency)).astype(np.complex64)
            for steps, frequency in zip(self._steps, frequencies, strict=True)
        )
        height, width = self._lf.shape[2:4]
        inner = (slice(self._margin, self._margin + height), slice(self._margin, self._margin + width))
        images = []
        for spectra in self._spectra:
            rows = zip(spectra, down, strict=True)
            photograph = sum(phase[:, None] * (row * across[:, None]).sum(axis=0) for row, phase in rows)
            images.append(scipy.fft.irfft2(photograph, s=self._field)[inner])
        return as_view(self._lf, np.stack(images, axis=-1) if self._lf.ndim == 5 else images[0])
