"""Power in the bins of object planes, from full fields: those of interleaved subsets of lenses, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse

from ..camera import PlenopticCamera
from ..optics import guards, rays
from ..optics.power import fraction, power
from ..optics.sampling import check_memory
from ..runtime.backend import backend
from ..runtime.fft import Field, resting_drjit
from .binning import axis_bins
from .elements import converging, through_lens, through_microlenses
from .grids import AxisStep, Plan, Step, Window, object_extent, plan, require_feasible
from .steps import Rows, Workspace, propagate


def reconstruct_subsets(
    image: np.ndarray,
    camera: PlenopticCamera,
    distances: Sequence[float],
    wavelength: float,
    *,
    interleave: int = 1,
    relay: bool = True,
    oversample: int = 1,
    progress: Callable[[float], None] = lambda done: None,
) -> list[np.ndarray]:
    """Propagate interleaved subsets of lenses coherently and add their intensities.

    See `waves.Power`; `interleave` is the period K of a subset along each axis, 1 is one coherent field.
    """
    columns, rows = (count * oversample for count in camera.bin_count)
    check_memory(8.0 * rows * columns * (len(distances) + 1), f"wave reconstruction on {columns} x {rows} bins")
    libraries = backend()
    totals = [libraries.arrays.zeros((rows, columns)) for _ in distances]
    lit = lit_window(image, camera)
    if lit is not None:
        grids = plan(camera, wavelength, distances, lit)
        require_feasible(grids, camera, wavelength, distances, lit)
        fields = FullFields(image, camera, wavelength, grids, lit, interleave=interleave, relay=relay)
        passed = 0.0
        for done, subset in enumerate(np.ndindex(interleave, interleave)):
            with resting_drjit():
                field = fields.at_main_lens(subset[::-1])
                passed += fields.power(field)
                for total, distance, step in zip(totals, distances, grids.to_objects, strict=True):
                    total += fields.in_bins(field, distance, step, oversample)
            progress((done + 1) / interleave**2)
        guards.judge(guards.PUPIL, 1 - passed / float(image.sum(dtype=np.float64)))
        for total, distance in zip(totals, distances, strict=True):
            # where the detector's edge cuts the light there is no telling
            axes = ((0, grids.to_mla.x), (1, grids.to_mla.y))
            if all(light == kept for light, kept in (object_extent(camera, distance, *axis) for axis in axes)):
                guards.judge(guards.OBJECT, 1 - fraction(float(total.sum()), passed))
    return [libraries.to_host(total) for total in totals]


def lit_window(image: np.ndarray, camera: PlenopticCamera) -> Window | None:
    """First and past-the-last column and row of the full detector that hold light; None where all is dark."""
    window = []
    for axis in (0, 1):
        lit = np.flatnonzero(image.any(axis=axis))
        if lit.size == 0:
            return None
        offset = camera.crop_offset[axis]
        window.append((offset + int(lit[0]), offset + int(lit[-1]) + 1))
    return window[0], window[1]


class FullFields:
    """The fields of one capture on its way back.

    Parameters
    ----------
    image : (rows, columns) float32 array
        The capture.
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    grids : Plan
        Sampling.
    lit : ((int, int), (int, int))
        The pixels that it was made for.
    interleave : int
        Period of the subsets.
    relay : bool
        Whether the microlenses act in the MLA plane.
    """

    def __init__(
        self,
        image: np.ndarray,
        camera: PlenopticCamera,
        wavelength: float,
        grids: Plan,
        lit: Window,
        *,
        interleave: int,
        relay: bool,
    ) -> None:
        self._camera, self._wavelength, self._grids = camera, wavelength, grids
        self._interleave, self._relay = interleave, relay
        self._workspace = Workspace(grids)
        rows, columns = (
            slice(first - offset, end - offset)
            for (first, end), offset in zip(lit[::-1], camera.crop_offset[::-1], strict=True)
        )
        self._lit = self._workspace.libraries.arrays.asarray(image[rows, columns])

    def at_main_lens(self, subset: tuple[int, int]) -> Field:
        """Field of a subset of lenses, by the remainders of its indices, just before the main lens.

        Returns
        -------
        complex64 array
            Zero outside the pupil; it holds until the next one is asked for.
        """
        camera, wavelength, workspace = self._camera, self._wavelength, self._workspace
        to_mla, to_main_lens = self._grids.to_mla, self._grids.to_main_lens
        rows = converging(self._amplitude(), to_mla, camera, wavelength, self._interleave, subset)
        rows = propagate(rows, to_mla, camera.detector_distance, wavelength, workspace)
        if self._relay:
            rows = through_microlenses(rows, to_main_lens, camera, wavelength)
        rows = propagate(rows, to_main_lens, camera.mla_distance, wavelength, workspace)
        arrays, field = workspace.libraries.arrays, workspace.array("pupil", to_main_lens.shape)
        x, y = (arrays.asarray(axis.destination) ** 2 for axis in (to_main_lens.x, to_main_lens.y))
        for place, samples in rows:
            arrays.multiply(samples, x + y[place, None] <= camera.aperture_radius**2, out=field[place])
        return field

    def _amplitude(self) -> Rows:
        """Square root of the lit pixels, sample by sample."""
        arrays, subsamples = self._workspace.libraries.arrays, self._grids.subsamples
        together = max(1, self._workspace.block // subsamples)
        for first in range(0, len(self._lit), together):
            amplitude = arrays.sqrt(self._lit[first : first + together])
            for axis in (0, 1) if subsamples > 1 else ():
                amplitude = arrays.repeat(amplitude, subsamples, axis)
            yield slice(first * subsamples, first * subsamples + len(amplitude)), amplitude

    def power(self, field: Field) -> float:
        """Power that passes the pupil, in pixel values times pixels."""
        return power(field) * self._grids.to_main_lens.sample_area / self._camera.pixel_size**2

    def in_bins(self, field: Field, distance: float, step: Step, oversample: int) -> np.ndarray:
        """Power in each bin of an object plane, of a field just before the main lens; (rows, columns) float32 array."""
        camera, workspace = self._camera, self._workspace
        rows = through_lens(workspace.blocks(field), step, camera.focal_length, self._wavelength)
        rows = propagate(rows, step, distance, self._wavelength, workspace)
        in_columns, in_rows = (
            _bin_matrix(camera, distance, axis, count * oversample, oversample)
            for axis, count in zip((step.x, step.y), camera.bin_count, strict=True)
        )
        return _sum_power(rows, in_columns, in_rows) * (step.sample_area / camera.pixel_size**2)


def _bin_matrix(
    camera: PlenopticCamera, distance: float, axis: AxisStep, count: int, oversample: int
) -> scipy.sparse.csr_array:
    """Fraction of each object-plane sample in each bin, both taken as intervals; (bins, samples)."""
    X = axis.destination[:, None] + np.array([-0.5, 0.5]) * axis.new_pitch
    u = rays.conjugate_coordinate(X, distance, camera.mla_distance) * (oversample / camera.mla_pitch) + count / 2
    bins = axis_bins(u[:, 0], u[:, 1], np.zeros(axis.wanted), count, 1.0)
    return scipy.sparse.csr_array((bins.weight, bins.pixel, bins.start), shape=(count, axis.wanted))


def _sum_power(field: Rows, in_columns: scipy.sparse.csr_array, in_rows: scipy.sparse.csr_array) -> np.ndarray:
    """Sum the squared moduli of a field over bins, rows first."""
    libraries = backend()
    # Real and imaginary parts lie side by side.
    total = libraries.arrays.zeros((in_rows.shape[0], 2 * in_columns.shape[1]), np.float32)
    for place, samples in field:
        total += libraries.sparse.csr_matrix(in_rows[:, place]) @ libraries.arrays.square(samples.view(np.float32))
    power = total.reshape(len(total), -1, 2).sum(-1)
    return (libraries.sparse.csr_matrix(in_columns) @ power.T).T
