r"""Sums of pixels over bins for any lattice.

A pixel p of the lens with centre c is projected to the position u(c) on the bins, through the point P(c) of the pupil.
Through another point c + d of its lens it is projected to u(c) + a d, with the same a for all pixels of one lens type.
Its footprint is the lens's aperture, enlarged by a, or the pixel's own square where that is wider. Pixels are therefore
first counted on a grid finer than the bins, one for each type of lens; the distribution of such a sample to the bins
around it is then the same in every bin. Everything is summed in a fixed order, so that the result is the same bit for
bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import numpy as np
import scipy.fft

from ..camera import PlenopticCamera
from ..design import lens_directions, lens_footprint, pixel_footprint
from ..optics import rays
from ..rays import Passage, Walk, detector_rows, follow_back, on_plane
from ..runtime import Array, Doubles, Flags, Shape, Triple, array_module, require_memory

# Samples of the fine grid across a bin at least.
_LEAST = 4

# Pixels followed at once: few enough to stay in the cache.
_BLOCK = 2**16


@dataclass(frozen=True)
class Splat:
    """Positions of pixels on the bins of an object plane, with their footprints.

    There are `fine` samples across a bin, and a footprint (taps, taps, fine, fine) of each type of lens. Pixels are
    also counted in `margin` bins beyond each border, from where they reach across it; `size` are rows and columns with
    these. Pixels that land there have a sample, counted bin by bin, a type of lens, and a flat index.
    """

    fine: int
    footprints: list[Array]
    margin: int
    size: Shape
    place: Array
    lens_type: Array
    pixel: Array

    @classmethod
    def of(
        cls, camera: PlenopticCamera, distance: float, radius: float, footprint: str, oversample: int, channels: int
    ) -> Splat:
        """Return the sums of an image's pixels (rows, columns, channels) by bin; float64, like the image."""
        focal_lengths = camera.mla_focal_lengths
        fine = 1
        footprints = [np.ones((1, 1, 1, 1))] * len(focal_lengths)
        if footprint == "lens":
            # 16: Samples of the fine grid across a lens pitch.
            fine = max(_LEAST, -(-16 // oversample))
            step = camera.row_pitch / (oversample * fine)
            footprints = [_in_bins(_footprint(camera, distance, f2, step), fine) for f2 in focal_lengths]
        # Pixels that land in bins beyond the border may still reach across it.
        margin = max(taps.shape[0] // 2 for taps in footprints)
        columns, rows = (count * oversample for count in camera.bin_count)
        across = columns + 2 * margin
        down = rows + 2 * margin
        require_memory(
            # Counted samples, bins, and what is known of every pixel while those of a block are joined.
            down * across * (24.0 * fine**2 + 8.0 * (channels + 2)) + 100.0 * camera.shape[0] * camera.shape[1],
            f"{columns} x {rows} bins with footprints of {2 * margin + 1} of them",
        )
        landing = _landing(camera, distance, radius, oversample, fine, (down, across))
        return cls(fine, footprints, margin, (down, across), *landing)

    def forward(self, image: Array) -> Array:
        """Return an image's pixels (rows, columns, channels) summed by bin; float64, like the image."""
        values = image.reshape(-1, image.shape[2])[self.pixel]
        down, across = self.size
        margin = self.margin
        total = np.zeros((image.shape[2], down + 2 * margin, across + 2 * margin))
        for mine, taps in self._types():
            first = margin - taps.shape[0] // 2
            for out, weights in zip(total, values.T, strict=True):
                samples = np.bincount(self.place[mine], weights[mine], down * across * self.fine**2)
                spread = _spread(samples.reshape(down, across, self.fine**2), taps)
                out[first : first + spread.shape[0], first : first + spread.shape[1]] += spread
        return np.moveaxis(total[:, 2 * margin : down, 2 * margin : across], 0, -1)

    def vjp(self, bins: Array, shape: Shape) -> Array:
        """Return the transpose of `forward`: float64 pixels (rows, columns, channels)."""
        margin = self.margin
        down, across = self.size
        padded = np.pad(np.asarray(bins, np.float64), ((2 * margin,) * 2, (2 * margin,) * 2, (0, 0)))
        result = np.zeros((shape[0] * shape[1], bins.shape[2]))
        for mine, taps in self._types():
            reach = taps.shape[0] // 2
            first = margin - reach
            for channel in range(bins.shape[2]):
                window = padded[first : first + down + 2 * reach, first : first + across + 2 * reach, channel]
                result[self.pixel[mine], channel] = _gather(window, taps).reshape(-1)[self.place[mine]]
        return result.reshape(*shape, -1)

    def _types(self) -> Iterator[tuple[slice | Array, Array]]:
        """Yield, for each type of lens, a mask of the pixels behind such lenses, and the pixels' footprint."""
        for index, taps in enumerate(self.footprints):
            yield slice(None) if len(self.footprints) == 1 else np.flatnonzero(self.lens_type == index), taps


def _spread(samples: Array, footprint: Array) -> Array:
    """Return the light of every fine sample spread over the surrounding bins."""
    taps = footprint.shape[0]
    footprint = footprint.reshape(taps, taps, -1)
    rows = samples.shape[0] + taps - 1
    columns = samples.shape[1] + taps - 1
    # Bins across a footprint up to which it is applied bin by bin; beyond that FFTs are faster.
    if taps <= 9:
        spread = np.zeros((rows, columns))
        for y, x in np.ndindex(taps, taps):
            spread[y : y + samples.shape[0], x : x + samples.shape[1]] += samples @ footprint[y, x]
        return spread
    shape = [scipy.fft.next_fast_len(size, real=True) for size in (rows, columns)]
    spectrum = sum(
        scipy.fft.rfft2(samples[..., fine], shape) * scipy.fft.rfft2(footprint[..., fine], shape)
        for fine in range(footprint.shape[2])
    )
    return scipy.fft.irfft2(spectrum, shape)[:rows, :columns]


def _gather(window: Array, footprint: Array) -> Array:
    """Return the transpose of `_spread`: (rows + taps - 1, columns + taps - 1) to (rows, columns, fine**2)."""
    from scipy.signal import fftconvolve  # loads slowly

    kernels = footprint.reshape(*footprint.shape[:2], -1)[::-1, ::-1]
    return fftconvolve(window[..., None], kernels, "valid", axes=(0, 1))


def _footprint(camera: PlenopticCamera, distance: float, mla_focal_length: float, step: float) -> Array:
    """Return the footprint of a pixel, of sum 1: its view of the lens or its own square, whichever is wider."""
    scale = lens_footprint(camera, distance, mla_focal_length)
    pixel = pixel_footprint(camera, distance)
    if scale * camera.lattice.aperture_width >= pixel:
        return camera.lattice.aperture_image(step, scale)
    half = max(0, math.ceil((pixel / step - 1) / 2))
    require_memory(16.0 * (2 * half + 1.0) ** 2, f"footprint of {2 * half + 1:.3g} samples across")
    side = np.ones(2 * half + 1)
    if half:
        side[[0, -1]] = (pixel / step - (2 * half - 1)) / 2
    return np.outer(side, side) / side.sum() ** 2


def _in_bins(blur: Array, fine: int) -> Array:
    """Return a footprint's fractions (taps, taps, fine, fine) in surrounding bins, if centred in each sample of a bin.

    The footprint is given in fine samples; its sum is 1.
    """
    half = blur.shape[0] // 2
    position = np.arange(fine) + np.arange(-half, half + 1)[:, None]
    reach = -(-half // fine)
    taps = np.arange(-reach, reach + 1)
    # Whether a sample of the footprint lies in the bin: (taps, size, fine).
    there = (position // fine == taps[:, None, None]).astype(np.float64)
    return np.einsum("iyr,yx,jxc->ijrc", there, blur, there, optimize=True)


def _landing(
    camera: PlenopticCamera, distance: float, radius: float, oversample: int, fine: int, shape: Shape
) -> Triple:
    """Return sample, lens type and flat index of the pixels whose ray passes the pupil and lands on the bins.

    Samples are counted bin by bin; the middle of the bins, rows and columns, is on the axis.
    """
    lattice = camera.lattice
    columns = camera.crop_size[0]
    places = []
    if camera.lens_data.images_stop:
        traced = stop_image_places(camera, distance)
    else:
        traced = thin_places(camera, distance, radius) if camera.lens_data.is_thin else traced_places(camera, distance)
    for rows, *position, is_lit in traced:
        lit = np.flatnonzero(is_lit)
        x, y = (
            values[lit] * (oversample / camera.row_pitch) + size / 2
            for values, size in zip(position, shape[::-1], strict=True)
        )
        column = np.floor(x).astype(np.int64)
        row = np.floor(y).astype(np.int64)
        sample = np.floor((y - row) * fine).astype(np.int64) * fine + np.floor((x - column) * fine).astype(np.int64)
        inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        lit = lit[inside]
        sample = ((row * shape[1] + column) * fine**2 + sample)[inside]
        lens_type = np.zeros(lit.size, np.int8)
        if len(camera.mla_focal_lengths) > 1:
            pixel = camera.pixel_coordinates(0)[lit % columns], camera.pixel_coordinates(1)[rows][lit // columns]
            lens = rays.chief_lenses(camera, *pixel)
            lens_type = lattice.lens_type(*lens).astype(np.int8)
        places.append([sample, lens_type, lit + rows.start * columns])
    sample, lens_type, pixels = (np.concatenate(parts) for parts in zip(*places, strict=True))
    return sample, lens_type, pixels


def pixel_rows(camera: PlenopticCamera, most: int) -> Iterator[tuple[slice, Doubles, Doubles]]:
    """Yield rows of about `most` pixels, with x and, in a column, y of the pixels' centres in millimetres."""
    x, y = (camera.pixel_coordinates(axis) for axis in (0, 1))
    height = max(1, most // x.size)
    for rows in (slice(first, first + height) for first in range(0, y.size, height)):
        yield rows, x, y[rows, None]


def thin_places(camera: PlenopticCamera, distance: float, radius: float) -> Iterator[tuple[slice, Array, Array, Array]]:
    """Yield the result of `traced_places` for a thin main lens, where rays are linear in pixel and lens centre."""
    of_pixel = np.array(follow_back(1.0, 0.0, 0.0, distance, camera))
    of_lens = np.array(follow_back(0.0, 1.0, 1.0, distance, camera))
    for rows, *p in pixel_rows(camera, _BLOCK):
        cell = rays.chief_lenses(camera, *p)
        (Px, x), (Py, y) = (
            [(pixel * q + lens * c) for pixel, lens in zip(of_pixel, of_lens, strict=True)]
            for q, c in zip(p, camera.lattice.centre(*cell), strict=True)
        )
        is_lit = Px**2 + Py**2 <= radius**2
        x, y = (np.broadcast_to(values, is_lit.shape).reshape(-1) for values in (x, y))
        yield rows, x, y, is_lit


def stop_image_places(camera: PlenopticCamera, distance: float) -> Iterator[tuple[slice, Doubles, Doubles, Flags]]:
    """Yield the result of `traced_places` in the Fourier arrangement, in bins times the pitch, along mean rays.

    The mean is over the part of a pixel's lens that the stop's image lights; other lenses than the pixel's own are
    taken to be dark.
    """
    lenses = lens_directions(camera)
    for rows, *places in pixel_rows(camera, _BLOCK):
        p = [values.ravel() for values in np.meshgrid(*places)]
        number = lenses.at(*camera.lattice.cell(*p))
        x, y = (
            -camera.row_pitch * ((q - middle) / camera.pixel_size + distance * slope / camera.bin_size(distance))
            for q, middle, slope in zip(p, lenses.middle[number].T, lenses.slope[number].T, strict=True)
        )
        yield rows, x, y, number >= 0


def traced_places(camera: PlenopticCamera, distance: float) -> Iterator[tuple[slice, Doubles, Doubles, Flags]]:
    """Yield the positions at which one ray per pixel, through the centre of its lens, meets an object plane.

    Yielded are rows of pixels, x and y of their positions in the object plane times -b / g in millimetres, which
    corrects the distortion, and whether the lens transmits the ray, or one from the middle of one of the pixel's edges.
    """
    types = array_module()
    walk = Walk.of(camera)
    half = camera.pixel_size / 2
    for rows, px, py in detector_rows(camera):
        lens = walk.lenslet(*walk.chief_cell((px, py))[1])
        lit = types.Bool(False)
        x = types.Float64(0)
        y = types.Float64(0)
        for across, down in ((-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)):
            traced = walk.trace((px + across * half, py + down * half), Passage(lens.centre, lens))
            lit |= traced[2]
            x, y = on_plane(traced, distance, camera.mla_distance)
        dr.eval(x, y, lit)
        yield rows, x.numpy(), y.numpy(), lit.numpy()
