"""Smooth functions over a cell from samples on a grid: bicubic splines, on NumPy and Dr.Jit."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import NO_ARRAY, InputError, refuse_if, refusing, require_module, require_number, require_wavelength
from ..runtime import IMAGE, Doubles, Facts, Pair, Shape, as_array, module_of, require_all, require_file, take, unit_of

COUNTS = 4, 1024
"""Least and largest count of samples along an axis."""


_LENGTHS = "m meter metre", "mm millimeter millimetre", "um µm micron micrometer micrometre", "nm nanometer nanometre"

LENGTHS = {unit: 1e3 ** (1 - step) for step, units in enumerate(_LENGTHS) for unit in units.split()}
"""Millimetres in units of length."""

_ANGLES = {"wave": 1.0, "rad": 0.5 / np.pi, "radian": 0.5 / np.pi}
"""Waves in units of phase."""


def phases(wave: float) -> dict[str, float]:
    """Return waves of a length in millimetres in units of path and of phase."""
    return {unit: length / wave for unit, length in LENGTHS.items()} | _ANGLES


def known_samples(name: str, value: Any, units: Mapping[str, float]) -> Doubles:
    """Return samples (rows, columns) from numbers or a file, limited in number and rounded to short decimals."""
    # Single precision is enough for a path, and its decimals are short in files.
    samples = read_samples(name, value, units).astype(np.float32)
    low, high = COUNTS
    refuse_if(
        not all(low <= size <= high for size in samples.shape),
        f"{name} of shape {samples.shape}: it must be {low} to {high} rows of as many columns",
    )
    require_all(name, samples, np.isfinite(samples), "finite")
    values = np.array([[float(str(sample)) for sample in row] for row in samples])
    values.flags.writeable = False
    return values


def read_table(name: str, value: Any, *, largest: int, most: float, decimals: int = 5) -> Doubles:
    """Return a table of numbers from 0 on, limited in size and rounded to the decimals that files hold."""
    values = read_samples(name, value, {})
    refuse_if(
        not all(1 <= size <= largest for size in values.shape),
        f"{name} of shape {values.shape}: it must have 1 to {largest} rows and columns",
    )
    require_all(name, values, (values >= 0) & (values <= most), f"from 0 to {most:g}")
    values = values.round(decimals)
    values.flags.writeable = False
    return values


def read_samples(name: str, value: Any, units: Mapping[str, float] | None) -> Doubles:
    """Return samples (rows, columns) from an array, nested lists, or a file: NPY, FITS, or an image of one channel.

    `units` are factors of the units that a file or a labelled array may state; others are refused. None stands for
    numbers whose unit does not matter.
    """
    header: Facts = {}
    if isinstance(value, (str, Path)):
        value, header = _read(require_file(Path(value)))
    unit = str(header.get("BUNIT", unit_of(value))).strip()
    rule = "it must be rows of numbers"
    samples = as_array(name, value, IMAGE[:2], rule=rule, units=(unit,))
    # Symbols of units differ by case.
    plain = unit if len(unit) < 3 else unit.lower().removesuffix("s")
    if units is not None and plain not in ("", "1", "dimensionless"):
        short_units = (
            ", ".join(name_of_unit for name_of_unit in units if name_of_unit.isascii() and len(name_of_unit) < 5)
            or "numbers without unit"
        )
        refuse_if(plain not in units, f"{name} in {unit!r}: it must be in {short_units}")
        if plain in _ANGLES and "WAVELEN" in header:
            nanometres = 1e9 * require_number("WAVELEN", header["WAVELEN"])
            samples *= require_wavelength(nanometres, "WAVELEN") * units["nm"]
        samples *= units[plain]
    refuse_if(samples.ndim != 2, f"{name} of shape {samples.shape}: it must be rows of as many columns")
    require_all(name, samples, np.isfinite(samples), "finite")
    return samples


def _read(path: Path) -> tuple[Any, Facts]:
    """Return the samples in a file, and the header of FITS."""
    ending = path.suffix.lower()
    if ending == ".npy":
        with refusing(f"{path}: it is no NPY file of numbers", OSError, *NO_ARRAY):
            return np.load(path, allow_pickle=False), {}
    if ending in (".exr", ".png"):
        import mitsuba as mi

        with refusing(f"{path}: it cannot be read as an image", RuntimeError):
            bitmap = mi.Bitmap(str(path))
            bitmap.set_srgb_gamma(False)
            image = np.array(bitmap.convert(bitmap.pixel_format(), mi.Struct.Type.Float32, srgb_gamma=False))
        channels = 1 if image.ndim == 2 else image.shape[2]
        refuse_if(channels > 1, f"{path}: it has {channels} channels; it must have one")
        return image.reshape(image.shape[:2]), {}
    if ending in (".fits", ".fit"):
        fits = require_module("astropy.io.fits", f"{path}: FITS needs a package: pip install 'mitsuba-plenoptic[ao]'")
        with refusing(f"{path}: it is no FITS file with an image", OSError, *NO_ARRAY):
            samples, header = fits.getdata(path, header=True)
            return samples, {**fits.getheader(path), **header}
    raise InputError(f"{path}: it must be an .npy, .exr, .png or .fits file")


class SampledGrid:
    """A bicubic spline through samples, centred on the lens; first and last column are `width` mm apart."""

    def __init__(self, samples: Doubles, width: float):
        self._samples = samples
        self._step = width / (samples.shape[1] - 1)

    @property
    def reach(self) -> Pair:
        """Offsets in mm of the outermost samples along x and y."""
        rows, columns = self._samples.shape
        return (columns - 1) * self._step / 2, (rows - 1) * self._step / 2

    def covers(self, x: Any, y: Any) -> Any:
        """Return a mask of offsets within the samples, up to rounding."""
        across, up = (half * (1 + 1e-6) for half in self.reach)
        return (abs(x) <= across) & (abs(y) <= up)

    @cached_property
    def _corners(self) -> Doubles:
        """Value, slope by column, slope by row, and mixed slope at each sample: (samples, 4)."""
        from scipy.interpolate import RectBivariateSpline

        rows, columns = (np.arange(size, dtype=float) for size in self._samples.shape)
        spline = RectBivariateSpline(rows, columns, self._samples)
        # A bicubic polynomial follows from these at its four corners.
        return np.stack([spline(rows, columns, dx=by_row, dy=by_column) for by_row, by_column in np.ndindex(2, 2)], -1)

    def at(self, x: Any, y: Any) -> Any:
        """Return the interpolated value at offsets; beyond the grid the value at its border."""
        return self._sum(x, y, (0, 0))

    def slopes(self, x: Any, y: Any) -> Pair:
        """Return the derivatives of the interpolated value along x and y."""
        return self._sum(x, y, (1, 0)) / self._step, self._sum(x, y, (0, 1)) / self._step

    def nearest(self, values: Doubles, x: Any, y: Any) -> Any:
        """Return, from other values of the samples, the value of the sample nearest to each offset."""
        (column, u), (row, v) = self._places(x, y)
        module = module_of(u)
        column = column + module.floor(u + 0.5)
        row = row + module.floor(v + 0.5)
        return take(values.ravel(), row * values.shape[1] + column)

    def _places(self, x: Any, y: Any) -> list[Pair]:
        """Return column and row of the sample before each offset, and the distances from this sample in samples."""
        places = []
        for coordinate, size in zip((x, y), self._samples.shape[::-1], strict=True):
            module = module_of(coordinate)
            scaled = module.minimum(module.maximum(coordinate / self._step + (size - 1) / 2, 0), size - 1)
            below = module.minimum(module.floor(scaled), size - 2)
            places.append((below, scaled - below))
        return places

    def _sum(self, x: Any, y: Any, derivative: Shape) -> Any:
        (column, u), (row, v) = self._places(x, y)
        across = _weights(u, derivative[0])
        up = _weights(v, derivative[1])
        total = 0.0
        for down, right in np.ndindex(2, 2):
            index = (row + down) * self._samples.shape[1] + column + right
            for corner, (by_row, by_column) in enumerate(np.ndindex(2, 2)):
                value = take(self._corners[..., corner].ravel(), index)
                total = total + value * across[right, by_column] * up[down, by_row]
        return total


def _weights(t: Any, derivative: int) -> dict[Shape, Any]:
    """Return the weights of Hermite's cubic, or their derivatives, for value and slope at each end."""
    if derivative:
        step = 6 * t * (1 - t)
        return {(0, 0): -step, (1, 0): step, (0, 1): 1 + t * (3 * t - 4), (1, 1): t * (3 * t - 2)}
    last = t * t * (3 - 2 * t)
    return {(0, 0): 1 - last, (1, 0): last, (0, 1): t * (1 - t) * (1 - t), (1, 1): t * t * (t - 1)}
