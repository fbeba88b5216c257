r"""Fields behind the microlenses for light of one direction, whose pairs of points give the array's kernels.

Light that reaches the detector around the landing point :math:`p_0` of a lens's centre is the Fourier transform of the
field over the direction cosines t with which light reaches :math:`p_0` (Debye's integral: Born and Wolf, "Principles of
optics", section 8.8.1). Fields are therefore sampled at even steps of :math:`x = z (t_0 - t)`, where :math:`t_0`
belongs to the lens's centre; in paraxial light x is the point m on the lens. Each x stands for the point

.. math:: m = p_0 - z\, t / c, \qquad c^2 = 1 - t^2 / n^2 ,

in a medium of index n at the reduced distance z. The field's phase there is that of the path from the pupil through m
to :math:`p_0`, and the amplitude per direction cosine is :math:`1/c^2`: :math:`c^2` by the inclination and the distance
(Rayleigh and Sommerfeld's integral: Goodman, "Introduction to Fourier optics", section 3.5), times :math:`d^2m / d^2x =
1/c^4`.
"""

import math

import numpy as np

from ..camera import PlenopticCamera
from ..fields import Kind, LensKinds, aperture_points
from ..optics import in_millimetres
from ..runtime import Array, Doubles, Flags
from .accuracy import USUAL

Pair = tuple[Doubles, Doubles]


class LensWaves:
    """Phases of a camera's microlenses at one wavelength, relative to the phases by which rays are deflected."""

    def __init__(self, camera: PlenopticCamera, wavelength: float):
        """Take a camera whose detector is near the microlenses' focus; one with glass is taken `at_wavelength`."""
        self.camera = camera
        self.wavelength = wavelength
        # Kernels are those of a lens among neighbours at regular distances.
        self.lattice = camera.lattice.regular
        self._lens_kinds = LensKinds(camera)
        self.kinds = self._lens_kinds.every
        # One kind of each focal length.
        self.types = self.kinds[: len(camera.mla_focal_lengths)]
        # Largest defocus of the waves behind microlenses on the detector, in radians at the edge of a lens.
        most = max(abs(self.convergence(kind)) for kind in self.kinds)
        self.defocus = math.pi * most * float(self.lattice.aperture_reach) ** 2 / in_millimetres(wavelength)
        # Widths in mm of a lens's diffraction on the detector, and of a lens.
        spot = in_millimetres(wavelength) * camera.reduced_distance / camera.lattice.aperture_width
        self.widths = spot, min(camera.mla_pitches)

    @property
    def aberration(self) -> float:
        """Deviation of the lenses' phase from the parabola by which rays land, in radians at the edge of a lens.

        It is computed from slopes, since a phase may have jumps.
        """
        shape = self.camera.microlens
        focal_length = self.camera.reduced_focal_lengths[0]
        offset = aperture_points(self.lattice)
        slopes = np.multiply(shape.deflection(self.lattice, *offset, focal_length), shape.strength(self.wavelength))
        most = float(np.hypot(*(slopes + np.divide(offset, focal_length))).max())
        return math.pi * most * float(self.lattice.aperture_reach) / in_millimetres(self.wavelength)

    def convergence(self, kind: Kind) -> float:
        """Return the wavefront curvature (1/mm) behind a lens for a pupil point, relative to focus on the detector."""
        # Waves from a point of an objective's stop are plane.
        vergence = self.camera.lens_data.converges / self.camera.pupil_distance
        return 1 / kind.distance + vergence - 1 / kind.focal_length

    def samples_of(self, count: int) -> int:
        """Return the number of samples across a pitch, given the number across an aperture."""
        return math.ceil(count * self.lattice.pitches[0] / self.lattice.aperture_width)

    def aperture_grid(self, samples: int) -> tuple[Doubles, Doubles, Flags]:
        """Return coordinates of a grid around a lens, in the frame of the lattice, and a mask of its aperture."""
        reach = self.lattice.cell_reach
        count = 2 * math.ceil(reach * samples / self.lattice.pitches[0])
        step = self.lattice.pitches[0] / samples
        along = (np.arange(count) + 0.5 - count / 2) * step
        v, u = np.meshgrid(along, along, indexing="ij")
        return u, v, self.lattice.in_aperture(*self.lattice.from_frame(u, v))

    def cosines(self) -> Doubles:
        """Return the direction cosines (n, 2) on the array, in the array's frame, of light from the pupil."""
        camera = self.camera
        field = np.linspace(-0.5, 0.5, USUAL.oblique_fields) if camera.lens_data.converges else np.zeros(1)
        pupil = np.linspace(-1, 1, USUAL.oblique_pupil) * camera.pupil_radius
        x, y, Px, Py = (
            coordinate.ravel()
            for coordinate in np.meshgrid(field * camera.detector_width, field * camera.detector_height, pupil, pupil)
        )
        inside = np.hypot(Px, Py) <= camera.pupil_radius
        slopes = (coordinate[inside] / camera.pupil_distance for coordinate in (x - Px, y - Py))
        u, v = self.lattice.to_frame(*slopes)
        return np.column_stack([u, v]) / np.sqrt(1 + u * u + v * v)[:, None]

    def spots(self, along: Doubles) -> Doubles:
        """Return the diffraction patterns (types, n, n) of single lenses, at detector positions along both axes."""
        u, v, inside = self.aperture_grid(USUAL.pitch_lags)
        wavelength = in_millimetres(self.wavelength)
        patterns = []
        for kind in self.types:
            scale = wavelength * kind.distance
            waves = np.exp(-2j * np.pi * np.outer(along, u[0]) / scale)
            # In front of the lens, whose phase follows.
            phase = (self.convergence(kind) + 1 / kind.focal_length) * (u * u + v * v) / (2 * wavelength)
            offset = self.lattice.from_frame(u, v)
            phase += self.camera.microlens.lens_waves(self.lattice, *offset, kind.focal_length, self.wavelength)
            field = waves @ np.where(inside, np.exp(2j * np.pi * phase), 0) @ waves.T
            patterns.append(np.abs(field) ** 2 * (u[0, 1] - u[0, 0]) ** 2 / (inside.sum() * scale**2))
        return np.stack(patterns)

    def cell_parts(self, step: float, kind: Kind) -> int:
        """Return the number of samples across a cell that resolves a lens's diffraction."""
        scale = in_millimetres(self.wavelength) * kind.distance
        return math.ceil(USUAL.cycle_samples * step * self.lattice.aperture_width / scale)

    def kernel_samples(self, step: float, reach: float, kind: int = 0) -> tuple[int, int, int]:
        """Return the sampling of kernels: lag step in fine samples, number of lags, samples on either side."""
        scale = in_millimetres(self.wavelength) * self.kinds[kind].distance
        fine = self.lattice.pitches[0] / USUAL.pitch_lags
        stride = max(1, int(scale / (2 * fine * reach)))
        # Pairs in neighbouring lenses are less than two cell widths apart; the grid resolves half a cycle per step.
        farthest = int(min(2 * USUAL.pitch_lags, scale / (2 * step * fine))) // stride
        return stride, farthest, math.ceil((scale / (fine * stride * step) + USUAL.border) / 2)

    def _plane(self, x: Pair, kind: Kind, cosines: tuple[float, float]) -> tuple[Pair, Array, Array]:
        r"""Return the points of the array that stand at positions `x` of kernels' pairs, for given direction cosines.

        The other results are the squares :math:`c^2` of the cosines of the angles of incidence, which are 0 where no
        light arrives, and the optical paths to the landing point of the lens's centre, less that from the centre.
        """
        index = self.camera.mla_medium
        z = kind.distance
        s = self.lattice.from_frame(*cosines)
        scale = z * self._lens_kinds.enlargement(kind.focal_length) / math.sqrt(1 - math.hypot(*s) ** 2 / index**2)
        landing = [component * scale for component in s]
        straight = math.hypot(index * z, *landing)
        tx, ty = (index * p / straight - q / z for p, q in zip(landing, x, strict=True))
        square = np.maximum(1 - (tx * tx + ty * ty) / index**2, 0)
        slant = 1 / np.sqrt(np.maximum(square, USUAL.grazing))
        return (
            (landing[0] - z * tx * slant, landing[1] - z * ty * slant),
            square,
            index * (index * z * slant - straight),
        )

    def transmission(self, x: Pair, kind: Kind, cosines: tuple[float, float]) -> tuple[Pair, Array, Array]:
        """Return the field of a lens and its neighbours at positions `x` of kernels' pairs, for given directions.

        Directions are cosines, in the lattice frame. The other results are the points of the array, relative to the
        lens's centre, and the part of each sample that belongs to the lens itself.
        """
        lattice = self.lattice
        camera = self.camera
        (mx, my), square, path = self._plane(x, kind, cosines)
        # Lens types alternate along a row.
        centre = lattice.centre(float(kind.lens_type), 0.0)
        i, j = lattice.cell(mx + centre[0], my + centre[1])
        cx, cy = (mx - c + c0 for mx, c, c0 in zip((mx, my), lattice.centre(i, j), centre, strict=True))
        # Neighbours are assumed to deviate as the lens itself does.
        focal_lengths = (
            np.array(camera.mla_focal_lengths) * kind.focal_length / camera.mla_focal_lengths[kind.lens_type]
        )
        types = lattice.lens_type(i, j).astype(int) if len(focal_lengths) > 1 else np.zeros(i.shape, int)
        vergence = camera.lens_data.converges / camera.pupil_distance
        sx, sy = lattice.from_frame(*cosines)
        path += sx * mx + sy * my + vergence * (mx * mx + my * my) / 2
        waves = path / in_millimetres(self.wavelength)
        waves += camera.microlens.lens_waves(lattice, cx, cy, focal_lengths[types], self.wavelength)
        amplitude = np.where(square < USUAL.grazing, 0, 1 / np.maximum(square, USUAL.grazing))
        # Samples at borders count in part, so that kernels change smoothly with the camera.
        step = x[0][0, 1] - x[0][0, 0]
        own_inset = lattice.aperture_inset(mx, my) / step
        if lattice.aperture == "cell" and (1 - lattice.fill) * lattice.pitches[0] < step:
            # Neighbours touch: all light passes, and is divided among them. Sums with these integrals of a B-spline of
            # order 2 depend little on where between samples the border is.
            inset = np.clip(own_inset, -1, 1)
            share = 0.5 + inset - inset * np.abs(inset) / 2
        else:
            # Across an opening the sum of these amplitudes, and that of their squares, is its width in steps.
            inset = lattice.aperture_inset(cx, cy) / step
            inside = np.clip(np.where(inset < 0.5, inset + 0.5, inset - 0.5), 0, 1)
            amplitude *= 0.5 * (1 + inside + np.where(inset < 0.5, -1, 1) * np.sqrt(1 - inside * inside))
            share = (own_inset > -0.5).astype(float)
        # Functions are undefined outside the aperture, where rays have no coefficients.
        return (mx, my), (amplitude * np.exp(2j * np.pi * waves)).astype(np.complex64), share
