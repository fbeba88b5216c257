"""Power in the bins of object planes, from full fields: those of interleaved subsets of lenses, one at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..camera import PlenopticCamera
from ..optics import guards
from ..optics.power import fraction, power
from ..runtime.backend import backend
from ..runtime.fft import Field, resting_drjit
from ..system.optical_system import OpticalSystem
from ..system.sampling import check_memory
from .bins import power_in_bins
from .conjugates import Conjugates, ThinConjugates
from .elements import NOTHING, converging, microlenses, to_object
from .grids import Directions, Plan, Strip
from .methods import Progress
from .planning import Window, field_memory, object_extent, plan, require_feasible
from .steps import Rows, Workspace, propagate, to_directions


def reconstruct_subsets(
    image: np.ndarray,
    camera: PlenopticCamera,
    distances: Sequence[float],
    wavelength: float,
    *,
    interleave: int = 1,
    relay: bool = True,
    oversample: int = 1,
    judged: bool = True,
    progress: Progress = lambda done: None,
    conjugates: Conjugates | None = None,
) -> list[np.ndarray]:
    """Propagate interleaved subsets of lenses coherently and add their intensities.

    See `waves.Power`; `interleave` is the period K of a subset along each axis, 1 is one coherent field.
    """
    conjugates = conjugates or ThinConjugates(OpticalSystem(camera, wavelength))
    columns, rows = (count * oversample for count in camera.bin_count)
    check_memory(8.0 * rows * columns * (len(distances) + 1), f"wave reconstruction on {columns} x {rows} bins")
    libraries = backend()
    totals = [libraries.arrays.zeros((rows, columns)) for _ in distances]
    lit = lit_window(image, camera)
    if lit is not None:
        grids = plan(camera, wavelength, distances, lit, oversample)
        require_feasible(grids)
        fields = FullFields(image, camera, wavelength, grids, lit, interleave=interleave, relay=relay)
        passed = 0.0
        for done, subset in enumerate(np.ndindex(interleave, interleave)):
            with resting_drjit():
                field = fields.at_main_lens(subset[::-1])
                passed += fields.power(field)
                for total, distance, step in zip(totals, distances, grids.to_objects, strict=True):
                    total += fields.in_bins(field, conjugates, distance, step, oversample)
            progress((done + 1) / interleave**2)
        if judged:
            guards.judge(guards.PUPIL, 1 - passed / float(image.sum(dtype=np.float64)))
            for total, distance in zip(totals, distances, strict=True):
                # where the detector's edge cuts the light there is no telling
                if all(light == seen for light, seen in (object_extent(camera, distance, i, lit[i]) for i in (0, 1))):
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
        self._at_mla: Field | None = None
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
        workspace, step = self._workspace, self._grids.main_lens
        field = workspace.array("pupil", step.shape)
        field[...] = 0
        x, y = step.x.destination, step.y.destination
        half = np.sqrt(np.maximum(self._camera.aperture_radius**2 - y**2, 0))
        first, end = np.searchsorted(x, -half), np.searchsorted(x, half, side="right")
        for strip in self._grids.strips:
            for place, samples in self._up(strip, subset):
                # A row's chord of the pupil: a mask would cost several times that.
                for row, line in zip(range(place.start, place.stop), samples, strict=True):
                    chord = slice(int(first[row]), int(end[row]))
                    field[row, chord] += line[chord]
        return field

    def _up(self, strip: Strip, subset: tuple[int, int]) -> Rows:
        """Take the light of a strip of the detector up to the main lens."""
        camera, wavelength, workspace = self._camera, self._wavelength, self._workspace
        onto, on = strip.to_mla, strip.to_main_lens
        if self._relay:
            # What strays to a cell from another lens's pixels is bent aside by a micro-image and misses the main lens:
            # so the light of all lenses goes to the MLA at once, and a subset is what its lenses let through.
            rows, lenses = self._all_at_mla(strip), microlenses(on, camera, wavelength, self._interleave, subset)
        else:
            light = converging(onto, camera, wavelength, self._interleave, subset)
            amplitude, lenses = self._amplitude(strip.rows), NOTHING
            rows = propagate(amplitude, light, onto, camera.detector_distance, wavelength, workspace)
        return propagate(rows, lenses, on, camera.mla_distance, wavelength, workspace)

    def _all_at_mla(self, strip: Strip) -> Rows:
        """Take the light of all lenses of a strip to the MLA; for several subsets it is kept if memory allows."""
        if self._at_mla is not None:
            yield from self._workspace.blocks(self._at_mla)
            return
        step, wavelength = strip.to_mla, self._wavelength
        light = converging(step, self._camera, wavelength, 1, (0, 0))
        rows = propagate(
            self._amplitude(strip.rows), light, step, self._camera.detector_distance, wavelength, self._workspace
        )
        grids, size = self._grids, 8.0 * step.shape[0] * step.shape[1]
        if self._interleave == 1 or len(grids.strips) > 1 or grids.memory + size > field_memory():
            yield from rows
            return
        kept = self._workspace.libraries.arrays.empty(step.shape, np.complex64)
        for place, samples in rows:
            kept[place] = samples
            yield place, samples
        self._at_mla = kept

    def _amplitude(self, strip: slice) -> Rows:
        """Square root of lit pixels, sample by sample."""
        arrays, subsamples = self._workspace.libraries.arrays, self._grids.subsamples
        together, lit = max(1, self._workspace.block // subsamples), self._lit[strip]
        for first in range(0, len(lit), together):
            amplitude = arrays.sqrt(lit[first : first + together])
            for axis in (0, 1) if subsamples > 1 else ():
                amplitude = arrays.repeat(amplitude, subsamples, axis)
            yield slice(first * subsamples, first * subsamples + len(amplitude)), amplitude

    def power(self, field: Field) -> float:
        """Power that passes the pupil, in pixel values times pixels."""
        return power(field) * self._grids.main_lens.sample_area / self._camera.pixel_size**2

    def in_bins(
        self, field: Field, conjugates: Conjugates, distance: float, step: Directions, oversample: int
    ) -> np.ndarray:
        """Power in each bin of an object plane, of a field just before the main lens; (rows, columns) float32 array."""
        camera, workspace = self._camera, self._workspace
        result = None
        for zone in conjugates.zones(distance):
            spectrum = to_directions(workspace.blocks(field), to_object(step, zone), step, workspace)
            power = power_in_bins(spectrum, step, camera, oversample) / camera.pixel_size**2
            if zone.bounds is None:
                return power
            result = power if result is None else result
            across, down = (
                slice(*(round(end * size) for end in ends))
                for ends, size in zip(zone.bounds, power.shape[::-1], strict=True)
            )
            result[down, across] = power[down, across]
        assert result is not None
        return result
