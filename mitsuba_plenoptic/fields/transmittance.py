r"""The microlens array as a thin element: the apertures, and the phase in each of them.

.. math:: t(m) = \exp\left(-i \pi \frac{n |m - c|^2}{\lambda f_2}\right)

in the aperture of the lens with centre c, and 0 between apertures (Goodman, "Introduction to Fourier Optics", section
5.1), n being the index of the medium behind the array; or the phase of the camera's `mla_shape`. If a grid cannot
represent the steep orders from the edges, orders are used instead: see `microlens_orders`.
"""

from typing import Any

import drjit as dr
import numpy as np

from ..array import Lattice, make_lattice
from ..camera import PlenopticCamera
from ..optics import in_millimetres, phasor, second_leg
from ..runtime import Pair, Sizes, fft, turn
from .accuracy import ACCURACY


def is_separable(camera: PlenopticCamera) -> bool:
    """Return whether the transmission is a product of a function of x and a function of y."""
    return camera.lattice.separable and len(camera.mla_focal_lengths) == 1 and camera.microlens.is_parabolic


def factor_axes(camera: PlenopticCamera) -> list[Sizes]:
    """Return the axes of each factor of the transmission, which has none without an array."""
    if not camera.has_array:
        return []
    return [(0,), (1,)] if is_separable(camera) else [(0, 1)]


def repetition(camera: PlenopticCamera) -> Pair:
    """Return the lattice's vectors, and the sides of the coarsest grid of all centres, in mm in the lattice frame.

    Without an array nothing repeats, and pixels are the grid.
    """
    if not camera.has_array:
        return np.zeros((2, 2)), np.full(2, camera.pixel_size)
    return np.array(camera.lattice.basis), np.array(camera.lattice.grid_step)


def upright(camera: PlenopticCamera) -> PlenopticCamera:
    """Return the camera in the frame that is rotated with the lattice about the axis."""
    if not camera.mla_rotation:
        return camera
    moved = camera.lattice.displacement
    warp = camera.mla_warp
    return camera.replace(
        mla_rotation=0.0,
        mla_offset=turn(*camera.mla_offset, -camera.mla_rotation),
        mla_warp=warp if moved is None else moved.turned(camera.mla_rotation).warp,
    )


def transmission(camera: PlenopticCamera, wavelength: float, x: Any, y: Any) -> Any:
    """Return the transmission with all orders, as Complex2f, at Dr.Jit float64 positions in millimetres."""
    types = fft.array_types(x)
    lattice = opaque_lattice(camera, types.Float64)
    lengths = types.Float64(camera.reduced_focal_lengths)
    dr.make_opaque(lengths)
    cell = lattice.cell(x, y)
    lens = camera.lenslet(*cell, lattice, lengths)
    offset = x - lens.centre[0], y - lens.centre[1]
    # The light of each cell passes its own lens, wherever this lies; displaced cells have no gaps between them.
    u, v = (x, y) if lattice.displacement is None else lattice.displacement.regular(x, y)
    cx, cy = lattice.regular.centre(*cell)
    inside = lattice.in_aperture(u - cx, v - cy)
    waves = camera.microlens.lens_waves(lattice, *offset, lens.focal_length, wavelength)
    if (error := camera.figure_error) is not None:
        waves += error.path(x, y) / in_millimetres(wavelength)
    return dr.select(inside, phasor(waves), 0)


def opaque_lattice(camera: PlenopticCamera, number: Any) -> Lattice:
    """Return the lattice with numbers that are not compiled into kernels, for positions in Dr.Jit arrays of a type."""
    numbers = [*camera.mla_pitches, camera.mla_rotation, *camera.mla_offset, camera.mla_fill]
    along, across, rotation, x, y, fill = (dr.opaque(number, value) for value in numbers)
    return make_lattice(
        camera.mla_lattice,
        # One array stands for equal pitches.
        (along, along if camera.mla_pitches[0] == camera.mla_pitches[1] else across),
        rotation=rotation if camera.mla_rotation else 0.0,
        offset=(x, y),
        aperture=camera.mla_aperture,
        fill=fill,
        displacement=camera.lattice.displacement,
    )


def has_response(camera: PlenopticCamera) -> bool:
    """Return whether pixels record a part of their light that depends on its direction behind the microlenses."""
    return bool(camera.pixel_response or camera.mla_absorption)


def clear(camera: PlenopticCamera) -> PlenopticCamera:
    """Return the camera without absorption, whose pixels record light of all directions alike."""
    if not has_response(camera):
        return camera
    return camera.replace(pixel_response=(), **{"mla_absorption": 0.0} if camera.mla_absorption else {})


def recorded_amplitude(camera: PlenopticCamera, sx: Any, sy: Any) -> Any:
    """Return the root of the part that pixels record of a plane wave's power, by direction cosines in the medium.

    Cosines are Dr.Jit float64 arrays; the result has single precision.
    """
    # 1 - 1e-6: Squared sine of the direction from which waves do not propagate.
    square = dr.minimum(sx * sx + sy * sy, 1 - 1e-6)
    depth = camera.space_behind[0] or 1.0
    power = second_leg(camera.pixel_response, camera.mla_absorption or 0.0, type(sx))
    return dr.float32_array_t(type(sx))(dr.sqrt(power(depth * dr.sqrt(square / (1 - square)), depth)))


def bend(camera: PlenopticCamera) -> float:
    """Return the largest change of a direction cosine by a microlens, along an axis: :math:`n D_2 / 2 f_2`."""
    lattice = camera.lattice
    slopes = np.abs(camera.microlens.deflection(lattice, *aperture_points(lattice), min(camera.reduced_focal_lengths)))
    return float(slopes.max() if lattice.regular.separable else np.hypot(*slopes).max())


def aperture_points(lattice: Lattice) -> Pair:
    """Return offsets of points that cover an aperture, including its rim."""
    x, y = lattice.aperture_point(*np.meshgrid(*2 * [np.linspace(0, 1, ACCURACY.slope_points)]))
    return np.asarray(x), np.asarray(y)


def scattering(camera: PlenopticCamera) -> float:
    """Return the largest change of direction cosine, by a microlens, up to which nearly all light is scattered.

    The edges of opaque gaps scatter more than the joints between lenses. Without an array nothing is scattered.
    """
    if not camera.has_array:
        return 0.0
    return bend(camera) * (1 if camera.lattice.fills else ACCURACY.hard_edges)


def diffraction(camera: PlenopticCamera, wavelength: float, orders: float) -> float:
    r"""Return the direction cosine of a high diffraction order of a microlens's aperture.

    The minima of an aperture of width w lie at multiples of :math:`\lambda / w`. Beyond the m-th minimum lies the
    fraction :math:`1 / \pi^2 m` of the light, for each axis (Goodman, "Introduction to Fourier Optics", section 4.4.1).
    Lenses without gaps scatter less than the edges of apertures: half the orders are used for them. Without an array
    there are no orders.
    """
    if not camera.has_array:
        return 0.0
    lattice = camera.lattice
    cosine = orders * in_millimetres(wavelength) / min(lattice.aperture_widths)
    return float(min(ACCURACY.steepest, cosine * (ACCURACY.joined if lattice.fills else 1)))
