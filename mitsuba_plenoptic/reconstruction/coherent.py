r"""Refocusing by coherent back-propagation of the square root of a capture.

The detector has lost the phase of the light. Coherent reconstruction supplies one: under each microlens, of centre
c, the light is taken to converge from its whole micro-image towards c,

.. math:: U_0(p) = \sqrt{I(p)} \, \exp\left(-i \pi \frac{|p - c|^2}{\lambda z}\right)

and goes back by the angular spectrum to the MLA, through the microlenses :math:`\exp(-i \pi |m - c|^2 / \lambda f_2)`,
to the main lens :math:`\exp(-i \pi P^2 / \lambda f_1)` and its pupil, and to the object plane, where
:math:`|U|^2` is summed over bins.

Why the microlens acts a second time
------------------------------------
The converging phase undoes what the microlens did on the way in, and it is tempting to go straight on to the main
lens. But at its focus in the MLA plane, a field that converges from z away is the Fourier transform of
:math:`\sqrt{I}` *times* :math:`\exp(i \pi |m - c|^2 / \lambda z)` (Goodman, "Introduction to Fourier Optics", section
5.2). If that factor stays, the light that reaches the main lens is not the micro-image enlarged but the micro-image
after :math:`(\lambda z)^{1/2}` of Fresnel blur: 18 um of a micro-image of 43 um for the paper's camera, where a
microlens has the Fresnel number 1.4. A blurred micro-image is a blurred pupil: every ray's direction is uncertain, and
planes out of focus come out with doubled edges, the more the farther they are. The microlens's own phase cancels the
factor (exactly for z = f2), and the pupil holds :math:`\sqrt{I}` itself. ``relay=False`` leaves it out, to show this.

Focused cameras
---------------
The two phases are right for :math:`z \neq f_2`, too. The chief ray of a pixel goes through the centre of its lens, so
light converges to there over z; and what is left after the microlens, :math:`\exp(-i \pi |m - c|^2 / \lambda a)`, makes
it converge once more, to :math:`\sqrt{I}` itself in the plane that the microlens sees, a before the MLA (or behind it)
with :math:`1/a + 1/z = 1/f_2`: the micro-image, enlarged, where the main lens's image is. Where micro-images are smooth
the light goes through a small part of the lens only, and what came from the rim of the pupil through the rim of a lens
misses the pupil on its way back; images are divided by what a white scene gives.

Partial coherence
-----------------
Light that passed different microlenses from different scene points never interferes, yet here the fields of all
lenses do. Fields of lenses in subsets (every K-th column and row), each propagated coherently, whose intensities are
added, interfere less; where the lenses of a subset are farther apart than their images are wide, not at all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ..camera import PlenopticCamera
from ..optics import guards, rays
from ..optics.microlenses import is_separable
from ..optics.sampling import check_memory
from ..runtime.backend import backend
from ..runtime.fft import Field
from ._binning import AxisBins, axis_bins, bin_image
from ._elements import (
    FieldThrough,
    Transmission,
    converging,
    converging_phase,
    detector_lens,
    lens_phase,
    microlens_phase,
    microlenses,
)
from ._legs import Workspace, propagate_leg
from ._plan import AxisLeg, Leg, Plan, object_extent, plan


def reconstruct_subsets(
    image: np.ndarray,
    camera: PlenopticCamera,
    distances: Sequence[float],
    wavelength: float,
    *,
    interleave: int = 1,
    relay: bool = True,
    oversample: int = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> list[np.ndarray]:
    """Propagate interleaved subsets of lenses coherently and add their intensities.

    Parameters
    ----------
    image : (rows, columns) float32 array
        The capture, not negative.
    camera : PlenopticCamera
        The camera; its recorded window is the image. Lenses are thin parabolic phase elements.
    distances : sequence of floats
        Object distances, which share the way up to the main lens.
    wavelength : float
        Wavelength in nanometres.
    interleave : int
        Period K of a subset along each axis; 1 is one coherent field.
    relay : bool
        Whether the microlenses act in the MLA plane.
    oversample : int
        Bins per lens along each axis.
    progress : callable
        Called with the share of the work done.

    Returns
    -------
    list of (rows, columns) float64 arrays
        Power in each bin, in pixel values times pixels.
    """
    columns, rows = (count * oversample for count in camera.bin_count)
    check_memory(8.0 * rows * columns * (len(distances) + 1), f"wave reconstruction on {columns} x {rows} bins")
    libraries = backend()
    totals = [libraries.arrays.zeros((rows, columns)) for _ in distances]
    lit = lit_window(image, camera)
    if lit is None:
        return [libraries.to_host(total) for total in totals]
    grids = plan(camera, wavelength, distances, lit)
    workspace = Workspace()
    fields = _pupil_fields(image, camera, wavelength, grids, lit, interleave, relay, workspace)
    area = grids.main_lens.x.new_pitch * grids.main_lens.y.new_pitch / camera.pixel_size**2
    passed = 0.0
    for done, field in enumerate(fields):
        passed += guards.power(field) * area
        for total, distance, leg in zip(totals, distances, grids.objects, strict=True):
            total += _object_image(field, camera, distance, wavelength, leg, oversample, workspace)
        progress((done + 1) / interleave**2)
    guards.judge(guards.PUPIL, 1 - passed / float(image.sum(dtype=np.float64)))
    for total, distance in zip(totals, distances, strict=True):
        # where the detector's edge cuts the light there is no telling
        axes = ((0, grids.detector.x), (1, grids.detector.y))
        if all(light == kept for light, kept in (object_extent(camera, distance, *axis) for axis in axes)):
            guards.judge(guards.OBJECT, 1 - guards.share(float(total.sum()), passed))
    return [libraries.to_host(total) for total in totals]


def lit_window(image: np.ndarray, camera: PlenopticCamera) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """First and past-the-last column and row of the full detector that hold light; None where all is dark."""
    window = []
    for axis in (0, 1):
        lit = np.flatnonzero(image.any(axis=axis))
        if lit.size == 0:
            return None
        offset = camera.crop_offset[axis]
        window.append((offset + int(lit[0]), offset + int(lit[-1]) + 1))
    return window[0], window[1]


def _pupil_fields(
    image: np.ndarray,
    camera: PlenopticCamera,
    wavelength: float,
    grids: Plan,
    lit: tuple[tuple[int, int], tuple[int, int]],
    interleave: int,
    relay: bool,
    workspace: Workspace,
) -> Iterator[Field]:
    """Field of each subset just before the main lens, zero outside the pupil, until the next one is asked for."""
    rows, columns = (
        slice(first - offset, end - offset)
        for (first, end), offset in zip(lit[::-1], camera.crop_offset[::-1], strict=True)
    )
    arrays = workspace.libraries.arrays
    amplitude = arrays.sqrt(arrays.asarray(image[rows, columns]))
    for axis in (0, 1) if grids.subsamples > 1 else ():
        amplitude = arrays.repeat(amplitude, grids.subsamples, axis)
    pupil = arrays.asarray(_pupil(camera, grids.main_lens))
    for j in range(interleave):
        for i in range(interleave):
            field = _at_mla(amplitude, camera, wavelength, grids.detector, interleave, (i, j), workspace)
            field = _at_main_lens(field, camera, wavelength, grids, relay, workspace)
            field *= pupil
            yield field


def _at_mla(
    amplitude: np.ndarray,
    camera: PlenopticCamera,
    wavelength: float,
    leg: Leg,
    interleave: int,
    subset: tuple[int, int],
    workspace: Workspace,
) -> Field:
    """Propagate the light of a subset of the lenses to the MLA."""
    source: np.ndarray | FieldThrough = amplitude
    if is_separable(camera):
        x, y = (
            _subset_source(camera, wavelength, along, axis, interleave, subset[axis])
            for axis, along in enumerate((leg.x, leg.y))
        )
    else:
        element = converging(camera, wavelength, interleave, subset)
        source, y, x = _through(amplitude, leg, element)
    return propagate_leg(source, y, x, leg, camera.detector_distance, wavelength, workspace, "plane")


def _at_main_lens(
    field: Field, camera: PlenopticCamera, wavelength: float, grids: Plan, relay: bool, workspace: Workspace
) -> Field:
    """Take light that reaches the MLA through the microlenses, if they act, and propagate it to the main lens."""
    leg = grids.main_lens
    source: np.ndarray | FieldThrough = field
    x, y = (np.ones(along.count, np.complex64) for along in (leg.x, leg.y))
    if relay and is_separable(camera):
        x, y = (
            microlens_phase(along.destination, camera, wavelength, axis)
            for axis, along in enumerate((grids.detector.x, grids.detector.y))
        )
    elif relay:
        source, y, x = _through(field, leg, microlenses(camera, wavelength))
    return propagate_leg(source, y, x, leg, camera.mla_distance, wavelength, workspace, "pupil")


def _through(field: np.ndarray, leg: Leg, element: Transmission) -> tuple[FieldThrough, np.ndarray, np.ndarray]:
    """Return a leg's source behind an element, and the factors along y and x that are left."""
    x, y = leg.x.source, leg.y.source
    return FieldThrough(field, x, y, element), np.ones(y.size, np.complex64), np.ones(x.size, np.complex64)


def _object_image(
    field: Field,
    camera: PlenopticCamera,
    distance: float,
    wavelength: float,
    leg: Leg,
    oversample: int,
    workspace: Workspace,
) -> np.ndarray:
    """Power in each bin of an object plane."""
    x, y = (lens_phase(axis.source, camera.focal_length, wavelength) for axis in (leg.x, leg.y))
    field = propagate_leg(field, y, x, leg, distance, wavelength, workspace, "plane")
    # Real and imaginary parts are binned side by side, in the memory they have.
    parts = field.view(np.float32).reshape(*field.shape, 2)
    workspace.libraries.arrays.square(parts, out=parts)
    bin_x, bin_y = (
        _sample_bins(camera, distance, axis, count * oversample, oversample)
        for axis, count in zip((leg.x, leg.y), camera.bin_count, strict=True)
    )
    power = bin_image(parts, bin_x, bin_y, 1.0).sum(-1)
    return power * (leg.x.new_pitch * leg.y.new_pitch / camera.pixel_size**2)


def _sample_bins(camera: PlenopticCamera, distance: float, axis: AxisLeg, count: int, oversample: int) -> AxisBins:
    """Share of each object-plane sample in each bin, both taken as intervals."""
    X = axis.destination[:, None] + np.array([-0.5, 0.5]) * axis.new_pitch
    u = rays.conjugate_coordinate(X, distance, camera.mla_distance) * (oversample / camera.mla_pitch) + count / 2
    return axis_bins(u[:, 0], u[:, 1], np.zeros(axis.wanted), count, 1.0)


def _subset_source(
    camera: PlenopticCamera, wavelength: float, along: AxisLeg, axis: int, interleave: int, subset: int
) -> np.ndarray:
    """Phase that makes the pixels of each lens converge to its centre; zero for lenses outside the subset."""
    index = detector_lens(along.source, camera, axis)
    phase = converging_phase(along.source, index, camera, wavelength, axis)
    return np.where(np.mod(index, interleave) == subset, phase, 0)


def _pupil(camera: PlenopticCamera, leg: Leg) -> np.ndarray:
    """1 within the main lens and 0 outside, float32."""
    x, y = leg.x.destination, leg.y.destination
    return (x**2 + y[:, None] ** 2 <= camera.aperture_radius**2).astype(np.float32)
