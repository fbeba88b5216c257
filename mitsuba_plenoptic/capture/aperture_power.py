"""How much of a point's light passes the apertures of microlenses with opaque gaps between them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..optics.microlens_orders import open_fraction
from ..optics.phase import in_millimetres
from ..runtime.backend import array_module
from ..runtime.fft import fft2, resting_drjit
from .patch_batches import Fields


def aperture_power(fields: Fields) -> NDArray[np.float64]:
    """Return the fraction of each point's power on the microlens array that is within apertures; (n,).

    The intensity before the array is band-limited, so that its integral over apertures of any shape is exact.
    """
    batch, grid = fields.make(np.ones(len(fields.positions))), fields.grid
    arrays, types = batch.libraries.arrays, array_module()
    count, directions = batch.mla_samples, batch.pupil.shape[1]
    pitch = batch.samples * grid.pitch / count
    cosine = in_millimetres(grid.wavelength) / (2 * float(pitch.min()))
    row, column = np.indices((count, count)).reshape(2, -1)
    result = np.empty(len(batch.pupil))
    for point, pupil in enumerate(batch.pupil):
        field = arrays.zeros((count, count), np.complex64)
        field[:directions, :directions] = pupil
        with resting_drjit():
            intensity: Any = arrays.abs(fft2(field, inverse=True)) ** 2
        x0, y0 = grid.origin + batch.corner[point] * grid.pitch
        x, y = types.Float64(x0 + column * pitch[0]), types.Float64(y0 + row * pitch[1])
        passed = batch.libraries.from_drjit(open_fraction(grid.camera, grid.wavelength, cosine, x, y))
        passed = intensity * passed.reshape(count, count)
        result[point] = float(passed.sum(dtype=np.float64) / intensity.sum(dtype=np.float64))
    return result
