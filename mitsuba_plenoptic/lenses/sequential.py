"""Ray tracing through a sequence of surfaces, with the optical paths.

All functions take floats, NumPy arrays or Dr.Jit arrays, and propagate the gradients that these carry. Lengths are
those of the prescription; a caller that scales a lens scales the arguments and the results.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..prescription import LEAST, Prescription, height
from ..runtime import Numbers, Triple, safe_sqrt, select
from .accuracy import ACCURACY


@dataclass(frozen=True)
class Element:
    """A surface of a lens, for light that travels towards increasing z.

    Parameters
    ----------
    gap : float
        Distance along the axis from the previous surface, or from where rays start.
    curvature : float
        Curvature, positive where the centre of curvature lies at higher z.
    conic : float
        Conic constant.
    asphere : tuple of float
        Coefficients of the fourth, sixth, ... powers of the distance from the axis.
    semi_aperture : float or Dr.Jit array
        Largest distance from the axis at which light passes.
    before, after : float or Dr.Jit array
        Refractive indices on both sides.
    """

    gap: Any
    curvature: float
    conic: float
    asphere: Numbers
    semi_aperture: Any
    before: Any
    after: Any

    @property
    def refracts(self) -> bool:
        """Whether the surface refracts: its indices differ, or are given for each ray."""
        plain = isinstance(self.before, float) and isinstance(self.after, float)
        return not plain or self.before != self.after


def elements(
    prescription: Prescription,
    wavelength: float,
    *,
    stop_radius: Any = None,
    backwards: bool = False,
    indices: Sequence | None = None,
) -> list[Element]:
    """Return a lens's surfaces in the order in which light meets them; the gap before the first is 0.

    Parameters
    ----------
    prescription : Prescription
        The lens.
    wavelength : float
        Wavelength in nanometres.
    stop_radius : float or Dr.Jit array, optional
        Radius of the stop. Default: fully open.
    backwards : bool
        Whether light travels from the array to the scene.
    indices : sequence of float or Dr.Jit array, optional
        Refractive indices behind each surface. Default: those at the wavelength.
    """
    surfaces = prescription.surfaces
    index = [1.0, *(prescription.indices(wavelength) if indices is None else indices)]
    steps = []
    for position, surface in enumerate(surfaces):
        stopped = position == prescription.stop and stop_radius is not None
        steps.append(
            (
                surfaces[position - 1].thickness if position else 0.0,
                surfaces[position].thickness if position < len(surfaces) - 1 else 0.0,
                surface,
                stop_radius if stopped else surface.semi_aperture,
                index[position],
                index[position + 1],
            )
        )
    if not backwards:
        return [Element(gap, s.curvature, s.conic, s.asphere, a, n, m) for gap, _, s, a, n, m in steps]
    return [
        Element(gap, -s.curvature, s.conic, tuple(-c for c in s.asphere), a, m, n) for _, gap, s, a, n, m in steps[::-1]
    ]


def widened(surface: Element, factor: float) -> Element:
    """Return a surface with a larger semi-aperture."""
    return dataclasses.replace(surface, semi_aperture=factor * surface.semi_aperture)


def follow(
    lens: Sequence[Element], point: Triple, direction: Triple, squares: list | None = None
) -> tuple[Triple, Triple, Any, Any]:
    r"""Return position, direction and path of rays behind a lens.

    A ray meets a conic at the parameter :math:`s = C / (B + \sqrt{B^2 - A C})` behind the plane of its vertex, with
    :math:`A = c (1 + k N^2)`, :math:`B = N - c (x L + y M)`, :math:`C = c (x^2 + y^2)` (Welford, "Aberrations of
    Optical Systems", section 4.3, with a conic constant), and an asphere by Newton iterations from there, or from the
    plane where that is nearer to the asphere. It is refracted by
    :math:`\mathbf{d}' = \eta \mathbf{d} + (\cos\theta' - \eta \cos\theta) \mathbf{n}` with :math:`\eta = n / n'`
    (Snell's law as a vector; same, section 4.4).

    Parameters
    ----------
    lens : sequence of Element
        The surfaces in the order in which light meets them.
    point : (array, array, array)
        Start points of the rays; z is measured from the first surface's vertex, less its `gap`.
    direction : (array, array, array)
        Direction cosines of the rays, of which the third is positive.
    squares : list, optional
        List that receives, for each surface, the squared distances from the axis at which rays meet it.

    Returns
    -------
    point : (array, array, array)
        Points where the rays leave the last surface; z is measured from its vertex.
    direction : (array, array, array)
        Direction cosines of the rays behind it.
    open : array
        Whether the rays pass all surfaces.
    path : array
        Optical path from the start point to the last surface.
    """
    x, y, z = point
    L, M, N = direction
    is_open = True
    path = 0.0
    for surface in lens:
        c = surface.curvature
        s = (surface.gap - z) / N
        x = x + s * L
        y = y + s * M
        if c or surface.asphere:
            A = c * (1 + surface.conic * N * N)
            B = N - c * (x * L + y * M)
            C = c * (x * x + y * y)
            root = B * B - A * C
            t = C / (B + safe_sqrt(root, LEAST))
            if surface.asphere:
                # An asphere may be nearer to its vertex's plane than to its conic, which rays may also miss.
                off = abs(t * N - height(surface, (x + t * L) * (x + t * L) + (y + t * M) * (y + t * M)))
                t = select((root > 0) & (off < abs(height(surface, x * x + y * y))), t, 0 * x)
                for _ in range(ACCURACY.newton_steps):
                    X = x + t * L
                    Y = y + t * M
                    square = X * X + Y * Y
                    rise = _slope(surface, square) * (X * L + Y * M)
                    step = (t * N - height(surface, square)) / (N - rise)
                    t = t - step
                met = abs(step) < ACCURACY.missing * surface.semi_aperture
                is_open = is_open & met
                t = select(met, t, 0 * x)
            else:
                is_open = is_open & (root > 0)
            x = x + t * L
            y = y + t * M
            z = t * N
            s = s + t
        else:
            z = 0.0
        path = path + surface.before * s
        square = x * x + y * y
        if squares is not None:
            squares.append(square)
        is_open = is_open & (square <= surface.semi_aperture * surface.semi_aperture)
        if surface.refracts:
            slope = _slope(surface, square)
            scale = 1 / safe_sqrt(1 + slope * slope * square, LEAST)
            nx = -slope * x * scale
            ny = -slope * y * scale
            nz = scale
            eta = surface.before / surface.after
            cosine = L * nx + M * ny + N * nz
            root = 1 - eta * eta * (1 - cosine * cosine)
            is_open = is_open & (root > 0)
            turn = safe_sqrt(root, LEAST) - eta * cosine
            L = eta * L + turn * nx
            M = eta * M + turn * ny
            N = eta * N + turn * nz
    return (x, y, z), (L, M, N), is_open, path


def _slope(surface: Element, square: Any) -> Any:
    """Return the derivative of a surface's height by the distance from the axis, divided by that distance."""
    c = surface.curvature
    slope = c / safe_sqrt(1 - (1 + surface.conic) * c * c * square, LEAST) if c else 0.0 * square
    power = square
    for order, coefficient in enumerate(surface.asphere, start=2):
        slope = slope + 2 * order * coefficient * power
        power = power * square
    return slope
