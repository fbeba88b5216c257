"""The field of one scene point behind the exit pupil and directly in front of the microlenses."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera, Vignetting
from ..errors import refuse_if
from ..fields import (
    AxisStep,
    FreeSpace,
    FromSpectrum,
    Hop,
    Link,
    OpticalSystem,
    Step,
    Watch,
    diffraction,
    is_paraxial,
    scattering,
)
from ..lenses import ClosedLens, ExitPupil, FourierLens, PointLight, ThinLens, cone
from ..optics import band_edge_fraction, guards, in_millimetres, phasor, power, power_by_row, soft_edge
from ..runtime import Doubles, Field, Pair, Shape, Triple, active_backend, check_memory, fft
from .pupil_weights import PupilWeights
from .sampling import Footprint, bundle_footprint, footprint
from .seen_pupil import SeenPupil

_PUPIL_BAND = 1.5
"""Sampled directions between pupil and MLA over the steepest ray, to contain diffraction by the pupil's edge."""

_PUPIL_SAMPLES = 250
"""Least samples across the pupil's radius: an edge softened over one sample loses a third of a sample's light."""

_KEPT_BENDS = 3.3
"""Lower bound of the band retained behind the microlenses, over the scattering of a wide microlens."""

_KEPT_ORDERS = 20
"""Lower bound of the same band, in diffraction orders of the aperture of a microlens."""

BLOCK = 512
"""Number of rows that are transformed together."""


@dataclass(frozen=True)
class FieldGrids:
    """Sizes and positions of a field's grids; pairs are along x and y."""

    pitch: float  # behind the MLA: an integer fraction of a pixel
    per_pixel: int
    wide_origin: Pair  # of the window that contains pupil, image and detector
    wide_pupil: int  # samples across it, at the pupil's pitch
    wide_mla: int  # samples across it, at the MLA's pitch
    offset: Shape  # of the detector's window in the wide window, in MLA samples
    count: Shape  # samples of the detector's window
    bend: float  # largest change of direction cosine by a microlens that the grid represents
    margin: int  # pixels between the window's edge and the first recorded pixel

    @property
    def origin(self) -> Pair:
        """Camera-frame x and y of the first sample of the detector's window."""
        left, top = (start + index * self.pitch for start, index in zip(self.wide_origin, self.offset, strict=True))
        return left, top

    @property
    def pupil_pitch(self) -> float:
        """Distance between samples of the wide window at the pupil."""
        return self.pitch * self.wide_mla / self.wide_pupil

    @property
    def shape(self) -> Shape:
        """Rows and columns of the detector's window."""
        return self.count[1], self.count[0]

    def to_array(self, columns: slice = slice(None), rows: slice = slice(None)) -> Step:
        """Return the step to the detector's window on the array, from some columns and rows of the wide window."""
        pitch = self.pupil_pitch
        wide = self.wide_pupil
        across, down = (
            AxisStep(first + part[0] * pitch, pitch, len(part), wide, self.wide_mla, start, count)
            for first, part, start, count in zip(
                self.wide_origin, (range(wide)[columns], range(wide)[rows]), self.origin, self.count, strict=True
            )
        )
        return Step(across, down)

    def to_detector(self, finer: int = 1) -> Step:
        """Return the step from the window on the array to the same on the detector, where samples may be finer."""
        across, down = (
            AxisStep(first, self.pitch, count, count, finer * count, first, finer * count)
            for first, count in zip(self.origin, self.count, strict=True)
        )
        return Step(across, down)


def field_grids(system: OpticalSystem, position: Doubles, refinement: float, growth: float) -> FieldGrids:
    """Return the grids of one scene point's field, with the parameters of `full_field`."""
    lens = system.waves_of_one(position)
    if isinstance(lens, ExitPupil):
        positions, cosines = lens.bundle
        image = bundle_footprint(positions.T[:, None], cosines.T[:, None], lens.pupil.distance)
    else:
        image = footprint(system.lens, position[None])
    label = f"full field of position = ({position[0]:g}, {position[1]:g}, {position[2]:g})"
    return grids_around(system, lens, image, position[None], label, refinement, growth)


def grids_around(
    system: OpticalSystem,
    lens: PointLight,
    image: Footprint,
    positions: Doubles,
    label: str,
    refinement: float = 1.0,
    growth: float = 1.0,
) -> FieldGrids:
    """Return grids that hold the fields of all scene points (n, 3) around an image; `what` names the work."""
    camera = system.camera
    wavelength = system.wavelength
    p = camera.pixel_size
    lam = in_millimetres(wavelength)
    radius = lens.pupil.radius
    steepest = float((np.abs(image.cosine) + image.half_cosine).max())
    aside = max(_KEPT_BENDS * scattering(camera), diffraction(camera, wavelength, _KEPT_ORDERS))
    # The pupil's edge bends light, too, which counts where nothing else does.
    bent = steepest + aside if aside else _PUPIL_BAND * steepest
    per_pixel = max(1, math.ceil(p * 2 * bent * refinement / lam))
    pitch = p / per_pixel
    # The recorded window on the detector, with a margin for light that travels sideways between MLA and detector.
    distance, medium = camera.space_behind
    sine = bent / medium
    reach = growth * distance * sine / math.sqrt(max(1e-3, 1 - sine**2))
    # 64: Samples between the window's edge, from which cut fields ring, and the recorded pixels if there is no array.
    margin = math.ceil(reach / p) if distance else math.ceil(64 / per_pixel)
    width = np.array([camera.detector_width, camera.detector_height])
    pixels = [fft.fast_length(size + 2 * margin) for size in camera.crop_size]
    start = -width / 2 + (np.array(camera.crop_offset) - margin) * p
    # The window between pupil and MLA, which is square and aligned with the pixels.
    low = np.minimum((image.centre - image.half_width).min(0), start)
    high = np.maximum((image.centre + image.half_width).max(0), start + np.array(pixels) * p)
    if lens.pupil.finite:
        low = np.minimum(-radius, low)
        high = np.maximum(radius, high)
        # 110: Least width of that window in units of :math:`\lambda b / D_1`, to contain diffraction by the pupil's
        # edge.
        diffracted = 110 * lam * lens.pupil.distance / (2 * radius)
    elif lens.pupil.swap is not None:
        # The field is sampled in the image of the stop itself.
        diffracted = 0.0
    else:
        # The number of samples of the stop is that of waves of the steepest direction across the window. Softening its
        # edge over one sample reduces the light that the edge diffracts far from the point's image.
        # 20: Least width of the window behind an objective, over the radius of a point's defocused image.
        blur = 20 * float(image.half_width.max())
        diffracted = max(_PUPIL_SAMPLES * lam / cone(system.lens, positions[:, 2]), blur)
    # 1.2: Width of the window between pupil and MLA over the extent that it must contain.
    extent = max(1.2 * float((high - low).max()), diffracted)
    wide = fft.fast_length(growth * extent / pitch + per_pixel, per_pixel)
    before = np.floor((start - (low + high - wide * pitch) / 2) / p).astype(int)
    finest = max(2 * _PUPIL_BAND * steepest / lam, _PUPIL_SAMPLES / radius)
    coarse = min(wide, fft.fast_length(wide * pitch * finest * refinement))
    detector_samples = pixels[0] * pixels[1] * per_pixel**2
    check_memory(
        # at the pupil, with the columns of the step to the MLA, or with those of the doubled grid of the detector
        8.0 * max(4 * coarse**2, 2 * coarse**2 + pixels[1] * per_pixel * coarse, 5 * detector_samples)
        + 32.0 * BLOCK * wide,
        label,
    )
    return FieldGrids(
        pitch=pitch,
        per_pixel=per_pixel,
        wide_origin=(float(start[0] - before[0] * p), float(start[1] - before[1] * p)),
        wide_pupil=coarse,
        wide_mla=wide,
        offset=(int(before[0]) * per_pixel, int(before[1]) * per_pixel),
        count=(pixels[0] * per_pixel, pixels[1] * per_pixel),
        bend=lam / (2 * pitch) - steepest,
        margin=margin,
    )


@dataclass(frozen=True)
class SampledField:
    r"""A complex field on a square grid in a plane of the camera."""

    # The sum of squared moduli times the squared pitch is the fraction of the power through the pupil. The carrier
    # :math:`\exp(i k d)` of the path from the main lens is omitted. The shape is (rows, columns).
    samples: Field
    # Camera-frame x and y of the first sample, in millimetres.
    origin: Pair
    # Distance between samples in millimetres.
    pitch: float

    @property
    def power(self) -> float:
        """Fraction of the power through the pupil that is on the grid."""
        return float(np.sum(np.abs(self.samples) ** 2, dtype=np.float64)) * self.pitch**2


def interpolated(field: SampledField, origin: Pair, pitch: float, shape: Shape) -> Field:
    """Return a field interpolated by its band limit on a grid of another pitch, of either sign."""
    arrays = active_backend().arrays
    # Along y, then along x.
    matrices = []
    for start, first, size, count in zip(origin[::-1], field.origin[::-1], shape, field.samples.shape, strict=True):
        at = start + pitch * np.arange(size)
        samples_at = first + field.pitch * np.arange(count)
        matrices.append(arrays.asarray(np.sinc((at[:, None] - samples_at) / field.pitch).astype(np.float32)))
    rows, columns = matrices
    return arrays.ascontiguousarray(rows @ arrays.asarray(field.samples.astype(np.complex64)) @ columns.T)


@dataclass(frozen=True)
class Arrival:
    """The way of light to the array: what enters the first link, the number of its first row, and the links.

    Without links the light enters on the array.
    """

    source: Field
    first: int
    links: tuple[Link, ...]


def arrival(
    system: OpticalSystem,
    position: Doubles,
    grids: FieldGrids,
    weights: PupilWeights | None,
    incident: SampledField | None = None,
) -> tuple[SampledField, Arrival]:
    """Return the light of a scene point (3,) on the pupil, and to the array, with the parameters of `full_field`."""
    camera = system.camera
    wavelength = system.wavelength
    lens = system.lens
    if not lens.pupil.finite:
        closed = cast(ClosedLens, lens)
        if lens.pupil.swap is not None:
            return stop_image_arrival(closed, position, wavelength, grids, weights, incident)
        return telecentric_arrival(closed, position, wavelength, grids, weights, camera.vignetting)
    pupil = pupil_field(system, position, grids, weights, incident)
    lit = active_backend().arrays.flatnonzero(power_by_row(pupil.samples))
    # In one transfer.
    first, last = active_backend().to_host(lit[[0, -1]]).tolist()
    paraxial = incident is not None and is_paraxial(camera)
    hop = to_array(camera, wavelength, grids.to_array(), paraxial)
    return pupil, Arrival(pupil.samples[first : last + 1], first, (hop,))


def pupil_field(
    system: OpticalSystem,
    position: Doubles,
    grids: FieldGrids,
    weights: PupilWeights | None,
    incident: SampledField | None,
) -> SampledField:
    """Return the field of a scene point behind the exit pupil, with the parameters of `full_field`."""
    types = active_backend().types
    count = grids.wide_pupil
    pitch = grids.pupil_pitch
    row, column = fft.rows_and_columns(types, count, count)
    step = dr.opaque(types.Float64, pitch)
    Px = types.Float64(column) * step + dr.opaque(types.Float64, grids.wide_origin[0])
    Py = types.Float64(row) * step + dr.opaque(types.Float64, grids.wide_origin[1])
    lens = system.waves_of_one(position)
    pupil = (Px, Py)
    point = _opaque(position)
    if incident is not None:
        if is_paraxial(system.camera):
            waves = cast(ThinLens, lens).paraxial_path(pupil, point[2], system.wavelength)
        else:
            waves = lens.path(pupil, point, system.wavelength)
        turned = fft.as_field(fft.pack(phasor(waves)), (count, count))
        entering = interpolated(incident, grids.wide_origin, pitch, (count, count)) / np.float32(incident.power**0.5)
        guards.check(guards.APERTURE, 1 - power(entering) * pitch**2)
        return SampledField(entering * turned, grids.wide_origin, pitch)

    # The edge is softened over one sample to make it round; the normalisation is that of the hard edge.
    def soften(inside: Any) -> Any:
        return types.Float(soft_edge(inside / step))

    cover = soften(lens.inside(pupil))
    bright = types.Float(lens.amplitude(pupil, point))
    density = types.Float64(bright * bright * cover)
    if (vignetting := system.camera.vignetting) is not None:
        seen_pupil = SeenPupil(vignetting, system.lens.bind(position[None]), lens.pupil.radius)
        cover = types.Float(seen_pupil.amplitude(pupil, point, soften))
    if weights is not None:
        passed, amplitude = weights.at(dr.zeros(types.UInt32, count * count), Px, Py, lens.pupil.radius, step)
        density *= types.Float64(passed)
        cover = cover * amplitude
    passing = dr.sum(density)[0] * pitch**2
    refuse_if(
        not 0 < passing < math.inf,
        f"aperture_radius = {system.camera.aperture_radius:g}: no light passes it on a grid of samples {pitch:g} apart",
    )
    field = phasor(lens.path(pupil, point, system.wavelength)) * (bright * cover / math.sqrt(passing))
    return SampledField(fft.as_field(fft.pack(field), (count, count)), grids.wide_origin, pitch)


def _opaque(position: Doubles) -> Triple:
    """Return a scene point (3,) whose coordinates are not compiled into kernels."""
    X, Y, g = (dr.opaque(active_backend().types.Float64, float(coordinate)) for coordinate in position)
    return X, Y, g


def to_array(camera: PlenopticCamera, wavelength: float, step: Step, paraxial: bool = False) -> Hop:
    """Return the way from the pupil to the array, whose guards look at the window's border along y."""
    return Hop(step, FreeSpace(camera.pupil_distance, wavelength, paraxial), check=_check_window)


def _check_window(watch: Watch) -> None:
    guards.check(guards.UNDERSAMPLED, watch.band_edge)
    guards.check_window(watch.in_rim)


def blocks(count: int) -> Iterator[slice]:
    """Yield slices of a range, which limit the memory of intermediate results."""
    for start in range(0, count, BLOCK):
        yield slice(start, min(count, start + BLOCK))


def telecentric_arrival(
    lens: ClosedLens,
    position: Doubles,
    wavelength: float,
    grids: FieldGrids,
    weights: PupilWeights | None,
    vignetting: Vignetting | None,
) -> tuple[SampledField, Arrival]:
    """Return the light of a scene point (3,) on the stop, and in the native image directly before the microlenses.

    Both have the power 1, except for light that misses the detector's window or that vignetting takes.
    """
    types = active_backend().types
    count = grids.wide_pupil
    pitch = grids.pupil_pitch
    step = in_millimetres(wavelength) / (count * pitch)
    frequencies = []
    # Lines of the spectrum are along y.
    for sample in fft.rows_and_columns(types, count, count):
        # Zero frequency comes first, as in transforms.
        index = types.Float64(sample)
        frequencies.append(dr.select(index < (count + 1) // 2, index, index - count))
    reach = lens.pupil.distance * step
    pupil = -frequencies[0] * dr.opaque(types.Float64, reach), -frequencies[1] * dr.opaque(types.Float64, reach)
    field = _stop_field(lens, position, wavelength, pupil, reach, weights, vignetting)
    # The first sample is at the corner of the detector's window.
    to_corner = [dr.opaque(types.Float64, start / (count * pitch)) for start in grids.origin]
    spectrum = field * phasor(frequencies[0] * to_corner[0] + frequencies[1] * to_corner[1])
    # The field on the stop is a density in position; the density in direction is larger by the focal length.
    scale = lens.pupil.distance * in_millimetres(wavelength) / (pitch * count) ** 2
    shape = count, count
    source = fft.as_field(fft.pack(spectrum * types.Float(scale)), shape)
    # Zero frequency in the middle.
    stop = active_backend().arrays.roll(fft.as_field(fft.pack(field), shape).T, (count // 2, count // 2), (0, 1))[
        ::-1, ::-1
    ]
    half = (count - 1) // 2
    link = FromSpectrum(grids.to_array(), _check_window)
    return SampledField(stop, (-half * reach, -half * reach), reach), Arrival(source, 0, (link,))


def stop_image_arrival(
    lens: ClosedLens,
    position: Doubles,
    wavelength: float,
    grids: FieldGrids,
    weights: PupilWeights | None,
    incident: SampledField | None,
) -> tuple[SampledField, Arrival]:
    """Return the light of `telecentric_arrival` for an array in the image of the stop."""
    types = active_backend().types
    columns, rows = grids.count
    scale = lens.pupil.stop_scale
    origin = grids.origin
    row, column = fft.rows_and_columns(types, rows, columns)
    pupil = tuple(
        (types.Float64(sample) * dr.opaque(types.Float64, grids.pitch) + dr.opaque(types.Float64, start)) * scale
        for sample, start in zip((column, row), origin, strict=True)
    )
    sample = grids.pitch * abs(scale)
    if incident is None:
        field = fft.as_field(fft.pack(_stop_field(lens, position, wavelength, pupil, sample, weights)), (rows, columns))
    else:
        turned = fft.as_field(fft.pack(phasor(lens.path(pupil, _opaque(position), wavelength))), (rows, columns))
        first = (origin[0] * scale, origin[1] * scale)
        pitch = grids.pitch * scale
        field = turned * interpolated(incident, first, pitch, (rows, columns)) / np.float32(incident.power**0.5)
        with fft.resting_drjit():
            guards.check(guards.UNDERSAMPLED, band_edge_fraction(fft.fft2(field.copy())))
    if isinstance(lens, FourierLens) and lens.objective.field_stop is not None:
        # Directions on the array are positions in the plane of the field stop.
        with fft.resting_drjit():
            spectrum = fft.fft2(field.copy())
        y, x = (
            np.fft.fftfreq(size, grids.pitch) * in_millimetres(wavelength) * lens.window.distance
            for size in spectrum.shape
        )
        # The edge is softened over one sample.
        inside = lens.field_inset(x, y[:, None]) / (x[1] - x[0])
        spectrum *= active_backend().arrays.asarray(soft_edge(inside).astype(np.float32))
        with fft.resting_drjit():
            field = fft.fft2(spectrum, inverse=True)
    stop = SampledField(
        field[::-1, ::-1], (origin[0] * scale - (columns - 1) * sample, origin[1] * scale - (rows - 1) * sample), sample
    )
    return stop, Arrival(field * np.float32(abs(scale)), 0, ())


def _stop_field(
    lens: ClosedLens,
    position: Doubles,
    wavelength: float,
    pupil: Pair,
    sample: float,
    weights: PupilWeights | None,
    vignetting: Vignetting | None = None,
) -> Any:
    """Return the field at positions on the stop, with power 1 before vignetting, its edge softened over one sample."""
    types = active_backend().types
    point = _opaque(position)

    def soften(inside: Any) -> Any:
        return types.Float(soft_edge(inside / sample))

    cover = soften(lens.inside(pupil))
    amplitude = types.Float(lens.amplitude(pupil, point))
    power = lens.power_through(position)
    if weights is not None:
        count = dr.width(pupil[0])
        passed, relative = weights.at(dr.zeros(types.UInt32, count), *pupil, lens.pupil.radius, sample)
        power = float(dr.sum(types.Float64(amplitude * amplitude * cover * passed))[0]) * sample**2
    if vignetting is not None:
        cover = types.Float(SeenPupil(vignetting, lens, lens.pupil.radius).amplitude(pupil, point, soften))
    if weights is not None:
        cover = cover * relative
    return phasor(lens.path(pupil, point, wavelength)) * (amplitude * cover / math.sqrt(power))
