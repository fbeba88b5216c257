r"""Refocusing by the wave model: the square root of a capture is propagated back as one wave, or in lens subsets.

The detector has lost the phase of the light. Coherent reconstruction supplies one: under each microlens, of centre
c, the light is taken to converge from its whole micro-image towards c,

.. math:: U_0(p) = \sqrt{I(p)} \, \exp\left(-i \pi \frac{|p - c|^2}{\lambda z}\right)

and is propagated back by the angular spectrum to the MLA, the microlenses :math:`\exp(-i \pi |m - c|^2 / \lambda f_2)`,
to the main lens :math:`\exp(-i \pi P^2 / \lambda f_1)` and its pupil, and to the object plane, where
:math:`|U|^2` is summed over bins.

Why the microlens acts a second time
------------------------------------
The converging phase undoes the effect of the microlens during the capture, which suggests that the microlens can be
left out. But at its focus in the MLA plane, a field that converges from a distance z is the Fourier transform of
:math:`\sqrt{I}` *times* :math:`\exp(i \pi |m - c|^2 / \lambda z)` (Goodman, "Introduction to Fourier Optics", section
5.2). If that factor stays, the light that reaches the main lens is not the micro-image enlarged but the micro-image
after :math:`(\lambda z)^{1/2}` of Fresnel blur: 18 um of a micro-image of 43 um for the paper's camera, where a
microlens has the Fresnel number 1.4. A blurred micro-image is a blurred pupil: every ray's direction is uncertain, and
planes out of focus come out with doubled edges, the more the farther they are. The microlens's own phase cancels the
factor (exactly for z = f2), and the pupil holds :math:`\sqrt{I}` itself. ``relay=False`` leaves it out, to show this.

Focused cameras
---------------
The two phases are right for :math:`z \neq f_2`, too. The chief ray of a pixel goes through the centre of its lens, so
light converges to there over z; the phase that remains behind the microlens,
:math:`\exp(-i \pi |m - c|^2 / \lambda a)`, makes it converge once more, to :math:`\sqrt{I}` itself in the plane that
the microlens sees, a before the MLA (or behind it) with :math:`1/a + 1/z = 1/f_2`: the micro-image, enlarged, where the
main lens's image is. Where micro-images are smooth the light goes through a small part of the lens only, and light from
the rim of the pupil through the rim of a lens misses the pupil on its way back; images are divided by white.

Partial coherence
-----------------
Light that passed different microlenses from different scene points never interferes, yet the fields of all lenses of a
coherent reconstruction do. Fields of lenses in subsets, every K-th column and row, interfere less; where the lenses of
a subset are farther apart than their images are wide, not at all. That limit is found by full fields with such a
period, or lens by lens, whichever costs less.

Full fields
-----------
The chain of full fields goes detector -> array -> pupil -> object plane, one field for each subset of lenses, and so
does its vjp back. It is linear in the amplitudes of the pixels; the power in bins is the square of its modulus.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..fields import (
    Chain,
    Directions,
    Element,
    FieldWorkspace,
    FreeSpace,
    Fresnel,
    Hop,
    LensAxis,
    OpticalSystem,
    Rows,
    Spectrum,
    Step,
    converging,
    is_paraxial,
    microlenses,
)
from ..optics import guards, phasor, power, soft_edge
from ..runtime import (
    Array,
    Doubles,
    Field,
    Floats,
    Integers,
    Named,
    Shape,
    active_backend,
    array_module,
    check_memory,
    fft,
    work_limit,
)
from .bins import BinSums
from .conjugates import Conjugates, FieldZone, RealConjugates, ThinConjugates, undistorted
from .lens_by_lens import LensTile, fine_bins, reconstruct_lens_by_lens, tile_lenses
from .methods import Progress, Task, method, portion, work_of
from .planning import (
    FIELD_MEMORY,
    OBJECT_MARGIN,
    FieldPlan,
    Strip,
    Window,
    check_pupil_diffraction,
    plan,
    require_feasible,
)
from .radiance import divided_by_white, lens_scale, over_lenses


@method("coherent", waves=True)
def coherent(task: Task, *, relay: bool) -> list[Array]:
    """Return images refocused by propagating the light back as one coherent wave."""
    return _refocus(task, 1, relay)


@method("partial", waves=True)
def partial(task: Task, *, interleave: int | str, relay: bool) -> list[Array]:
    """Return images refocused by propagating the light back as one wave for each subset of lenses, or for each lens."""
    return _refocus(task, interleave, relay)


def _refocus(task: Task, interleave: int | str, relay: bool) -> list[Array]:
    """Return the refocused images, channel by channel."""

    def sums_of(image: Array, distances: Sequence[float], progress: Progress) -> list[Array]:
        # The shortest waves, which take the most memory, come first.
        channels = np.argsort(task.wavelengths).tolist()
        works = work_of([task.wavelengths[channel] for channel in channels])
        by_channel = {}
        for index, channel in enumerate(channels):
            system = task.system(task.wavelengths[channel])
            arguments = image[..., channel], system, distances, task.distances, interleave, relay, task.oversample
            # What the guards find is of the capture, whether or not its white is known already.
            by_channel[channel] = _signed_power(
                *arguments, portion(progress, index, works), checked=image is task.image
            )
        of_planes = zip(*(by_channel[channel] for channel in sorted(by_channel)), strict=True)
        return [np.stack(planes, axis=-1) for planes in of_planes]

    key = tuple(task.wavelengths), interleave, relay
    return divided_by_white(task, sums_of, task.camera.lit_radius, "lens", "waves", *key)


def signed_parts(image: Array) -> list[tuple[float, Array]]:
    """Return the non-negative pixels with the sign 1 and, if any, the magnitudes of negative ones with the sign -1.

    Amplitudes are square roots. Pixels below zero, which `expose` may make of dark ones, are refocused separately, and
    their image is subtracted: noise of mean zero then leaves no light on average.
    """
    if image.min() >= 0:
        return [(1.0, image)]
    return [(sign, np.maximum(sign * image, 0)) for sign in (1.0, -1.0)]


def _signed_power(
    image: Array,
    system: OpticalSystem,
    distances: Sequence[float],
    planned: Sequence[float],
    interleave: int | str,
    relay: bool,
    oversample: int,
    progress: Progress,
    checked: bool,
) -> list[Array]:
    """Return the power in bins, in pixel values times pixels, spread over lenses if lenses are not aligned with bins.

    The propagation to the main lens is done once for all distances. Seen from behind, a real main lens is a thin one.
    Fields have the samples that all `planned` distances need, since ratios of images of single planes, such as
    displacements, are far more sensitive to the samples than the images are.
    """
    camera = system.camera
    wavelength = system.wavelength
    fine = fine_bins(system, oversample)
    real = None
    thin = camera
    columns, rows = (count * oversample * fine for count in camera.bin_count)
    check_memory(8.0 * rows * columns * (len(distances) + 1), f"wave reconstruction on {columns} x {rows} bins")
    planes = list(distances)
    sampled = list(planned)
    if camera.lens_data.traced_surfaces:
        real = RealConjugates.of(system, sampled, oversample)
        thin = real.camera
        planes, sampled = ([real.distance(distance) for distance in group] for group in (distances, planned))
    parts = signed_parts(image)
    powers = [np.zeros(()) for _ in distances]
    for index, (sign, part) in enumerate(parts):
        # Guards look at the light, not at the noise below zero.
        options: Named = {"relay": relay, "oversample": oversample * fine, "checked": checked and sign > 0}
        options |= {
            "progress": portion(progress, index, [1] * len(parts)),
            "conjugates": real or ThinConjugates(system),
        }
        period = full_field_period(part, thin, planes, wavelength) if isinstance(interleave, str) else interleave
        if period is None:
            totals = reconstruct_lens_by_lens(part, thin, planes, wavelength, **options)
        else:
            totals = reconstruct_subsets(part, thin, planes, wavelength, interleave=period, planned=sampled, **options)
        for plane, (total, distance) in enumerate(zip(totals, distances, strict=True)):
            scale = lens_scale(camera, distance)
            if real is not None:
                total, stretch = undistorted(total, real, camera, distance, oversample * fine)
                scale *= stretch
            if fine > 1 or real is not None:
                total = over_lenses(total, camera, oversample, fine, scale)
            powers[plane] = powers[plane] + sign * total
    return powers


def full_field_period(
    image: Array, camera: PlenopticCamera, distances: Sequence[float], wavelength: float
) -> int | None:
    """Return the period from which on subsets of lenses do not interfere, or None if single lenses are cheaper.

    Full fields are cheaper near focus, where few subsets suffice. The cost is the number of transformed samples.
    """
    lit = lit_window(image, camera)
    if lit is None:
        return 1
    blur = max(camera.blur_diameter(g) for g in distances) / min(camera.mla_pitches)
    # Bins between the geometric images of two lenses that do not interfere, for diffraction.
    period = math.ceil(blur - 1e-6) + 2
    tile = LensTile(camera, wavelength, tile_lenses(camera, distances), 1)
    lenses = math.prod((end - first) / camera.pixels_per_lens for first, end in lit)
    single = lenses * tile.transformed * len(distances)
    # A field takes at least this; how much more needs grids, of which those of large cameras are not worth planning.
    if period**2 * math.prod(end - first for first, end in lit) >= single:
        return None
    return period if period**2 * plan(camera, wavelength, distances, lit).transformed < single else None


def reconstruct_subsets(
    image: Array,
    camera: PlenopticCamera,
    distances: Sequence[float],
    wavelength: float,
    *,
    interleave: int = 1,
    relay: bool = True,
    oversample: int = 1,
    checked: bool = True,
    progress: Progress = lambda done: None,
    conjugates: Conjugates | None = None,
    planned: Sequence[float] | None = None,
) -> list[Array]:
    """Return the power in bins of object planes, from subsets of lenses propagated coherently.

    The image must not be negative. The propagation to the main lens is done once for all distances. The period of a
    subset along each axis is `interleave`; 1 is one coherent field. If `checked`, guards check the light that is lost.
    Grids are chosen for the `planned` distances, by default these ones, so that several calls can share samples. Powers
    (rows, columns) are in pixel values times pixels.
    """
    conjugates = conjugates or ThinConjugates(OpticalSystem(camera, wavelength))
    columns, rows = (count * oversample for count in camera.bin_count)
    totals = [np.zeros((rows, columns)) for _ in distances]
    lit = lit_window(image, camera)
    if lit is None:
        return totals
    planned = list(planned or distances)
    grids = plan(camera, wavelength, planned, lit, oversample)
    grids = replace(grids, to_objects=tuple(grids.to_objects[planned.index(distance)] for distance in distances))
    require_feasible(grids)
    zones = [list(conjugates.zones(distance)) for distance in distances]
    to_planes = [step for step, parts in zip(grids.to_objects, zones, strict=True) for _ in parts]
    fields = BackwardFields(
        camera, wavelength, grids, interleave=interleave, relay=relay, to_planes=to_planes, progress=progress
    )
    sums = [BinSums(step, camera, wavelength, oversample) for step in grids.to_objects]
    inside = tuple(
        slice(first - offset, end - offset) for (first, end), offset in zip(lit, camera.crop_offset, strict=True)
    )
    passed = 0.0
    with fft.resting_drjit():
        for field in fields.at_pupil(np.sqrt(image[inside[::-1]])):
            passed += fields.power(field)
            for total, parts, step, bins in zip(totals, zones, grids.to_objects, sums, strict=True):
                for zone in parts:
                    found = active_backend().to_host(bins.forward(fields.to_object(field, zone, step)))
                    part = zone.part(found.shape)
                    total[part] += found[part]
    progress(1.0)
    if checked:
        guards.check(guards.PUPIL, 1 - passed / float(image.sum(dtype=np.float64)))
        for distance in distances:
            check_pupil_diffraction(camera, wavelength, distance, OBJECT_MARGIN)
    return totals


def lit_window(image: Array, camera: PlenopticCamera) -> Window | None:
    """Return the first column and row of the full detector with light, and those after the last; None if dark."""
    window = []
    for axis in (0, 1):
        lit = np.flatnonzero(image.any(axis=axis))
        if lit.size == 0:
            return None
        offset = camera.crop_offset[axis]
        window.append((offset + int(lit[0]), offset + int(lit[-1]) + 1))
    return window[0], window[1]


class BackwardFields:
    """Linear map from the amplitudes of a plan's pixels to the fields of subsets of lenses, with its vjp.

    A subset is every `interleave`-th lens along both indices of the lattice. Without `relay` the microlenses do not act
    in the MLA plane, and there is no vjp. `progress` is told the work of all subsets, to the main lens and by the steps
    `to_planes` from there.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        wavelength: float,
        grids: FieldPlan,
        *,
        interleave: int,
        relay: bool = True,
        with_vjp: bool = False,
        to_planes: Sequence[Step] = (),
        progress: Progress = lambda done: None,
    ):
        self._camera = camera
        self._wavelength = wavelength
        self._grids = grids
        self._interleave = interleave
        self._relay = relay
        shorter = camera.medium_wavelength(wavelength)
        paraxial = is_paraxial(camera)
        self._to_mla = FreeSpace(camera.detector_distance, shorter, paraxial)
        self._beyond_paraxial = FreeSpace(camera.mla_distance, wavelength, paraxial, beyond_paraxial=True)
        on_array = sum(8.0 * math.prod(strip.to_mla.shape) for strip in grids.strips)
        steps = list(grids.steps)
        if with_vjp:
            steps += [step.reversed for step in steps]
            columns = max(math.prod(step.columns) for step in steps)
            # The gradients on the array are held whole, and so are the fields at the directions.
            at_object = sum(
                8.0 * (interleave**2 + 1) * step.x.new_padded * step.y.new_padded for step in grids.to_objects
            )
            memory = grids.memory + 8.0 * columns + 2 * on_array + at_object
            check_memory(memory, "derivatives of a wave reconstruction", most=FIELD_MEMORY)
        self._pupil = _Pupil(grids.pupil, camera.aperture_radius)
        # The light of all lenses on the array serves every subset, where it fits into memory.
        self._holds = interleave > 1 and relay and len(grids.strips) == 1
        held = grids.memory + on_array
        self._holds &= held <= min(FIELD_MEMORY, work_limit(held))
        if self._holds:
            check_memory(held, "a wave reconstruction by subsets", most=FIELD_MEMORY)
        once = [strip.to_mla for strip in grids.strips] if self._holds else []
        each = [step for strip in grids.strips for step in strip.steps if step not in once] + list(to_planes)
        # To write what is held, to memory never used before, takes as long as the transforms of that.
        held = sum(step.transformed for step in once)
        work = 2 * held + interleave**2 * sum(step.transformed for step in each)
        self._workspace = FieldWorkspace(
            steps, lambda transformed: progress((transformed + min(transformed, held)) / work)
        )

    @property
    def _subsets(self) -> list[Shape]:
        return [(i, j) for j, i in np.ndindex(self._interleave, self._interleave)]

    def at_pupil(self, amplitude: Floats) -> Iterator[Field]:
        """Yield every subset's field directly before the main lens, in lines along y, zero outside the pupil.

        Each field is valid until the next one is requested.
        """
        amplitude = self._workspace.libraries.arrays.asarray(amplitude)
        held = None
        if self._holds:
            (strip,) = self._grids.strips
            held = self._workspace.whole(self._on_array(strip, amplitude, None), strip.to_mla.shape)
        for subset in self._subsets:
            field = self._at_pupil()
            for strip in self._grids.strips:
                if held is not None:
                    light = self._workspace.blocks(held)
                else:
                    light = self._on_array(strip, amplitude, None if self._relay else subset)
                self._add_within(field, self._to_pupil(strip, subset).forward(light, self._workspace))
            yield field

    def _at_pupil(self) -> Field:
        """Return a zero field on the main lens, in lines along y."""
        field = self._workspace.array("pupil", (self._grids.pupil[0].count, self._grids.pupil[1].count))
        field[...] = 0
        return field

    def _to_pupil(self, strip: Strip, subset: Shape) -> Chain:
        """Return the way from the array to the main lens, through the microlenses of a subset."""
        step = strip.beyond_paraxial
        lenses = None
        if self._relay:
            lenses = microlenses(step, self._camera, self._wavelength, self._interleave, subset)
        path = Fresnel(strip.to_main_lens, self._grids.pupil, self._camera.mla_distance, self._wavelength)
        return Chain([Hop(step, self._beyond_paraxial, lenses), path])

    def to_object(self, field: Field, zone: FieldZone, step: Directions) -> Rows:
        """Yield the field at the directions of an object plane, from the field directly before the main lens."""
        return Spectrum(step, _main_lens(step, zone)).forward(self._workspace.blocks(field), self._workspace)

    def vjp(self, gradients: Iterable[Field], zone: FieldZone, step: Directions) -> Doubles:
        """Return the gradient with respect to the amplitudes, from the gradients of all subsets' fields."""
        workspace = self._workspace
        arrays = workspace.libraries.arrays
        on_array = [arrays.zeros(strip.to_mla.shape, np.complex64) for strip in self._grids.strips]
        to_object = Spectrum(step, _main_lens(step, zone))
        for subset, gradient in zip(self._subsets, gradients, strict=True):
            field = self._at_pupil()
            self._add_within(field, to_object.adjoint(workspace.blocks(arrays.asarray(gradient)), workspace))
            for strip, own in zip(self._grids.strips, on_array, strict=True):
                for rows, samples in self._to_pupil(strip, subset).adjoint(workspace.blocks(field), workspace):
                    own[rows] += samples
        found = []
        n = self._grids.subsamples
        for strip, own in zip(self._grids.strips, on_array, strict=True):
            onto = strip.to_mla
            light = self._to_array(strip, None).adjoint(workspace.blocks(own), workspace)
            real = workspace.libraries.to_host(workspace.whole(light, onto.reversed.shape)).real
            shape = onto.y.count // n, n, onto.x.count // n, n
            found.append(real.reshape(shape).sum((1, 3), dtype=np.float64))
        return np.concatenate(found)

    def power(self, field: Field) -> float:
        """Return the power of a field that passes the pupil, in pixel values times pixels."""
        x, y = self._grids.pupil
        return power(field) * x.pitch * y.pitch / self._camera.pixel_size**2

    def _on_array(self, strip: Strip, amplitude: Floats, subset: Shape | None) -> Rows:
        """Return the field on the MLA from a strip of the detector, of all lenses or of a subset.

        Light that strays from another lens's pixels into a cell is deflected by a micro-image and misses the main lens.
        So the light of all lenses may propagate to the MLA at once; a subset is the light that passes its lenses.
        """
        pixels = self._workspace.repeated(amplitude[strip.rows], self._grids.subsamples)
        return self._to_array(strip, subset).forward(pixels, self._workspace)

    def _to_array(self, strip: Strip, subset: Shape | None) -> Hop:
        """Return the way from a strip of the detector to the array, for the light of all lenses or of a subset."""
        light = converging(strip.to_mla, self._camera, self._wavelength, self._interleave, subset)
        return Hop(strip.to_mla, self._to_mla, light)

    def _add_within(self, field: Field, blocks: Rows) -> None:
        """Add lines to a field within the pupil, with the pupil's edge softened over one sample."""
        for lines, samples in blocks:
            numbers, places, passed = self._pupil.edge(lines)
            to_device = self._workspace.libraries.arrays.asarray
            samples[to_device(numbers), to_device(places)] *= passed
            # A line's chord of the pupil: a mask of the whole would cost several times that.
            for index, line in zip(range(lines.start, lines.stop), samples, strict=True):
                chord = self._pupil.chord(index)
                field[index, chord] += line[chord]


class _Pupil:
    """Samples of a round pupil, line by line along y, with fractions for samples on the edge."""

    def __init__(self, axes: tuple[LensAxis, LensAxis], radius: float):
        arrays = active_backend().arrays
        across, along = (axis.pitch for axis in axes)
        x, y = (axis.samples for axis in axes)
        outer, inner = (
            np.sqrt(np.maximum((radius + side * math.hypot(across, along)) ** 2 - x**2, 0)) for side in (0.5, -0.5)
        )
        self._first, self._end = np.searchsorted(y, -outer), np.searchsorted(y, outer, side="right")
        ends = np.stack([self._first, np.searchsorted(y, -inner), np.searchsorted(y, inner, side="right"), self._end])
        places = [np.r_[first:low, max(low, high) : end] for first, low, high, end in ends.T.tolist()]
        self._starts = np.concatenate([[0], np.cumsum([len(own) for own in places])])
        lines = np.repeat(np.arange(len(x)), np.diff(self._starts))
        self._places = np.concatenate(places)
        px = x[lines]
        py = y[self._places]
        away = np.maximum(np.hypot(px, py), min(across, along))
        passed = soft_edge((radius - away) / np.hypot(px * across / away, py * along / away))
        self._lines, self._passed = lines, arrays.asarray(passed.astype(np.float32))

    def chord(self, line: int) -> slice:
        """Return the slice of a line's samples that pass, at least in part."""
        return slice(int(self._first[line]), int(self._end[line]))

    def edge(self, lines: slice) -> tuple[Integers, Integers, Any]:
        """Return edge samples of some lines, by line and position, and the part of the field that passes."""
        samples = slice(int(self._starts[lines.start]), int(self._starts[lines.stop]))
        return self._lines[samples] - lines.start, self._places[samples], self._passed[samples]


def _main_lens(step: Directions, zone: FieldZone) -> Element:
    """Return the main lens as an element, less the path to the object point in the middle of a zone of the field."""
    light = zone.light
    pitch = min(step.x.pitch, step.y.pitch)

    # Lines of the main lens are along y.
    def lens(y: Any, x: Any) -> Any:
        passed = phasor(light.path((x, y)))
        return passed * soft_edge(array_module().Float(light.inside((x, y)) / pitch)) if zone.is_cut else passed

    return Element(step, lens)
