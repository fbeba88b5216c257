r"""Fit of a microscope in the Fourier arrangement to its white picture: array, image of the stop, and field stop.

Each lens shows the evenly lit field stop, as bright as the stop lights a part of the lens. So the places of these
micro-images give the lattice, their size the field stop, and the light of lenses that the stop's edge cuts the centre
and the radius of its image on the array.
"""

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import median_filter
from scipy.optimize import least_squares
from scipy.special import ndtr

from ...camera import PlenopticCamera
from ...errors import refuse_if
from ...runtime import Array, Doubles, as_array
from .white_fit import of_size
from .white_frames import stuck

NUMBERS = {
    "mla_pitch": "mm", "mla_rotation": "degrees", "mla_offset x": "mm", "mla_offset y": "mm", "stop x": "mm",
    "stop y": "mm", "numerical_aperture": "", "field_stop": "mm",
}  # fmt: skip
"""What a fit finds, with units: places of the stop's image are from the middle of the picture, `mla_offset` from it."""

_COARSE, _FINE = 8, 25
"""Samples across the radius of a micro-image at most, of a search and of the fit; finer pictures are averaged."""


@dataclass(frozen=True)
class StopFit:
    """A microscope fitted to its white picture.

    Attributes
    ----------
    camera : PlenopticCamera
        The fitted camera, whose axis is the centre of the stop's image, within a quarter of a pixel: a picture with
        another middle is a crop.
    numbers, deviations : dict of str to float
        Values of `NUMBERS`, and their standard deviations by the picture's noise.
    residual : float
        RMS difference of the picture from its model, over the light of whole lenses.
    """

    camera: PlenopticCamera
    numbers: dict[str, float]
    deviations: dict[str, float]
    residual: float


def fit_stop(white: Array, camera: PlenopticCamera) -> StopFit:
    """Fit a microscope to a picture of something evenly white.

    Parameters
    ----------
    white : (rows, columns) array
        Values of the sensor less its black level, proportional to light. Single dead and hot pixels are left out.
    camera : PlenopticCamera
        The camera as it is known. The pitch may be off by 3 %, the rotation by 5 degrees, the aperture and the field
        stop by a fifth; of `mla_offset` nothing need be known.

    Raises
    ------
    InputError
        If the picture shows no such micro-images.
    """
    white = as_array("white", white, shape=(None, None))
    refuse_if(not np.ptp(white) > 0, "white: all of its pixels are alike")
    dead, hot = stuck(white, 0.01 * float(np.quantile(white, 0.9)))
    white = np.where(dead | hot, median_filter(white, 3), white)
    camera = of_size(camera, white.shape[::-1])
    lens: Any = camera.objective
    refuse_if(lens.field_stop is None, "main_lens: the white picture is of no field_stop, which ends micro-images")
    coarse, model = (_WhiteModel(white, camera, lens, samples) for samples in (_COARSE, _FINE))
    likeliest = min((coarse.fitted(start, 20) for start in coarse.starts()[:3]), key=lambda fit: fit.cost)
    fit = model.fitted(likeliest.x)
    residual = math.sqrt(np.mean(fit.fun**2))
    deviations = residual * np.sqrt(np.diag(np.linalg.pinv(fit.jac.T @ fit.jac)).clip(0))
    values, residual = fit.x, residual / abs(float(fit.x[8]))
    refuse_if(
        not (residual <= 0.1 and values[6:9].min() > 0),
        f"white: it differs by {residual:.1%} of its light from micro-images behind {lens.label} (at most 10%): it is "
        "no white picture, or not by this camera",
    )
    pitch, turn, x, y, stop_x, stop_y, radius, half = values[:8]
    array = {"mla_pitch": tuple(pitch * np.array(camera.mla_pitches)), "mla_rotation": float(turn)}
    # The offset is that of the lens next to the axis.
    lattice = camera.replace(**array, mla_offset=(0.0, 0.0)).lattice
    first = np.array(lattice.centre(0.0, 0.0))
    offset = np.array([x, y]) - first
    nearest = np.array(lattice.centre(*lattice.cell(*(np.array([stop_x, stop_y]) - offset))))
    offset += nearest - first
    # The axis in pixels from the picture's corner, and the full film whose middle is there.
    size = np.array(white.shape[::-1])
    axis = np.array([stop_x, stop_y]) / camera.pixel_size + size / 2
    before = np.maximum(0, np.ceil(size - 2 * axis - 0.5)).astype(int)
    full = np.rint(2 * (axis + before)).astype(int)
    offset -= (full / 2 - before - size / 2) * camera.pixel_size
    aperture, stop = radius * lens.magnification / lens.last_focal_length, half / model.scale
    fitted = camera.replace(
        main_lens=replace(lens, numerical_aperture=aperture, field_stop=stop),
        **array,
        mla_offset=tuple(offset.tolist()),
        resolution=tuple(full.tolist()),
        detector_width=camera.pixel_size * int(full[0]),
        crop_offset=tuple(before.tolist()),
        crop_size=tuple(size.tolist()),
    )
    values[:8] = pitch * camera.mla_pitches[0], turn, *offset, stop_x, stop_y, aperture, stop
    deviations[[0, 6, 7]] *= [camera.mla_pitches[0], aperture / radius, stop / half]
    found, errors = (dict(zip(NUMBERS, numbers.tolist(), strict=False)) for numbers in (values, deviations))
    return StopFit(fitted, found, errors, residual)


class _WhiteModel:
    """A white picture of a microscope, as a function of twelve numbers.

    These are the pitch over the known one, the rotation in degrees, and the place of the lens (0, 0), the centre and
    the radius of the stop's image, and the radius or half the width of micro-images, in mm from the picture's middle;
    then the light of whole lenses, a background, the blur of edges in samples, and the power of the cosine with which
    light falls to outer lenses: 0 for surfaces that obey Lambert's law, -1 for a thin layer of fluorescence.
    """

    def __init__(self, white: Array, camera: PlenopticCamera, lens: Any, samples: int):
        self._camera, self._lens = camera, lens
        # From the native image plane to the detector.
        self.scale = camera.reduced_distance / lens.last_focal_length
        self._half = float(lens.field_stop or 0) * self.scale
        # Points across a lens that tell the part that the stop lights.
        self._points = int(2.5 * samples)
        finer = max(1, int(self._half / camera.pixel_size / samples))
        self._sample = camera.pixel_size * finer
        # Means over pixels, of whole blocks.
        rows, columns = (size // finer for size in white.shape)
        blocks = white[: rows * finer, : columns * finer].reshape(rows, finer, columns, finer)
        self._white = blocks.mean((1, 3))
        self._x, self._y = (
            camera.pixel_coordinates(axis)[: count * finer].reshape(count, finer).mean(1)
            for axis, count in ((0, columns), (1, rows))
        )

    def fitted(self, values: Doubles, steps: int | None = None) -> Any:
        """Return SciPy's result of a least-squares fit from start values, in at most some steps."""
        light, turn = abs(values[8]), math.degrees(self._sample / values[6])
        pace = 0.1 * np.array([self._sample / values[6], turn, *[self._sample] * 6, light, light, 1.0, 1.0])

        def off(values: Doubles) -> Doubles:
            return (self._image(values) - self._white).ravel()

        def slopes(values: Doubles) -> Doubles:
            here = off(values)
            return np.stack([(off(values + step) - here) / step.sum() for step in np.diag(pace)], -1)

        return least_squares(off, values, slopes, x_scale=pace, method="lm", max_nfev=steps)

    def starts(self) -> list[Doubles]:
        """Return numbers of cameras with other pitches, rotations and offsets than the known one, likeliest first."""
        camera = self._camera
        white = self._white - np.quantile(self._white, 0.02)
        across, up, total = white.sum(0), white.sum(1), white.sum()
        stop = np.array([across @ self._x, up @ self._y]) / total
        # Mean squares of discs of discs, and the light of lenses that are as many as fit the stop's image.
        square = (across @ (self._x - stop[0]) ** 2 + up @ (self._y - stop[1]) ** 2) / total
        radius, bright = math.sqrt(max(2 * square - self._half**2, self._half**2)), np.quantile(self._white, 0.9)
        area = total / bright * self._sample**2 * float(camera.lattice.cell_area) / (math.pi * radius**2)
        half = math.sqrt(area / (4 if self._lens.field_stop_shape == "square" else math.pi))
        rest = [*stop, radius, half, bright, 0.0, 1.0, 0.0]
        result = []
        for turn in camera.mla_rotation + np.linspace(-5, 5, 5):
            basis = np.array(camera.replace(mla_rotation=float(turn)).lattice.basis)
            for pitch, i, j in itertools.product(np.linspace(0.97, 1.03, 3), np.arange(6) / 6, np.arange(6) / 6):
                result.append(np.array([pitch, turn, *(pitch * (i * basis[0] + j * basis[1]) + stop), *rest]))
        return sorted(result, key=lambda values: float(np.square(self._image(values) - self._white).sum()))

    def _image(self, values: Doubles) -> Doubles:
        """Return the picture of numbers."""
        pitch, turn, x, y, stop_x, stop_y, radius, half, light, background, blur, power = values.tolist()
        camera, lens = self._camera, self._lens
        lattice = camera.replace(
            mla_pitch=tuple(pitch * np.array(camera.mla_pitches)), mla_rotation=turn, mla_offset=(0.0, 0.0)
        ).lattice
        first = np.array(lattice.centre(0.0, 0.0)) - (x, y)
        far = radius + float(lattice.aperture_reach)
        around = first + np.array([stop_x, stop_y])
        index = lattice.lenses_within(tuple(around - far), tuple(around + far))
        centres = np.stack(lattice.centre(*index.T.astype(float)), -1) - first
        aside = lattice.aperture_grid(self._points)
        reach, defocus = float(lattice.aperture_reach), 1 - camera.reduced_distance / camera.reduced_focal_lengths[0]
        image = np.full(self._white.shape, background)
        wide = abs(half) + 4 * self._sample * (abs(blur) + 1)
        edge = self._sample * math.sqrt(blur**2 + 1 / 12)
        for centre in centres:
            x, y = (c - s for c, s in zip(centre, (stop_x, stop_y), strict=True))
            inset = radius - math.hypot(x, y)
            if abs(inset) < reach:
                inside = (radius - np.hypot(x + aside[0], y + aside[1])) * (self._points / 2 / reach)
                inside = (inside + 0.5).clip(0, 1)
                lit = float(inside.mean())
                # Out of focus, light of a part of a lens is beside that of the whole.
                centre = centre + defocus * (aside @ inside) / max(inside.sum(), 1)
            else:
                lit = float(inset > 0)
            sine = math.hypot(x, y) * lens.magnification / (lens.last_focal_length * lens.immersion)
            columns, rows = (
                slice(*np.searchsorted(axis, (c - wide, c + wide)))
                for axis, c in zip((self._x, self._y), centre, strict=True)
            )
            if lit > 0 and columns.start < columns.stop and rows.start < rows.stop:
                u, v = self._x[columns] - centre[0], (self._y[rows] - centre[1])[:, None]
                if lens.field_stop_shape == "square":
                    shape = ndtr((half - abs(u)) / edge) * ndtr((half - abs(v)) / edge)
                else:
                    shape = ndtr((half - np.hypot(u, v)) / edge)
                image[rows, columns] += light * lit * max(1 - sine**2, 0.01) ** (power / 2) * shape
        return image
