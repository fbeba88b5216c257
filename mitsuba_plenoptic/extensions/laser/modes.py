r"""The number of independent speckle patterns over which partially coherent light on a rough surface averages.

The contrast of speckle is :math:`1 / \sqrt M`. For light of a distribution S over a parameter q (angle of incidence,
frequency), in parts that are mutually incoherent, and patterns with the correlation :math:`\mu` between parts,

.. math:: \frac{1}{M} = \iint S(q) \, S(q') \, |\mu(q - q')|^2 \, dq \, dq' = \int K(\Delta) \, |\mu(\Delta)|^2 \,
    d\Delta,

with S of integral 1 and its autocorrelation K (J. W. Goodman, "Speckle Phenomena in Optics", 2007, chapter 4, for the
sum of correlated patterns, and chapter 6 for angles and frequencies).
"""

from __future__ import annotations

import math

import numpy as np

from ...camera import PlenopticCamera, Use, require_camera, require_support
from ...errors import refuse_if, require_number, require_wavelength, suggest_keywords
from ...optics import in_millimetres
from ...runtime import Doubles


@suggest_keywords
def mode_count(
    camera: PlenopticCamera,
    *,
    wavelength: float,
    distance: float,
    source_diameter: float = 0.0,
    source_distance: float | None = None,
    bandwidth: float = 0.0,
    roughness: float = 0.0,
) -> float:
    r"""Return the number M of speckle patterns that a camera averages for a source's size and spectrum.

    An incoherent disc of angular radius :math:`\alpha_s`, seen from the surface, moves the speckle over the pupil of
    angular radius :math:`\alpha_p`, as the angle of incidence changes. The patterns of two angles in the image of the
    surface correlate by the overlap of two pupils, :math:`C(\Delta / 2 \alpha_p)` with
    :math:`C(s) = \frac{2}{\pi} (\arccos s - s \sqrt{1 - s^2})`, so that

    .. math:: \frac{1}{M_s} = \frac{2}{\alpha_s^2} \int_0^{2 \alpha_s} C(\Delta / 2 \alpha_s) \,
        C^2(\Delta / 2 \alpha_p) \, \Delta \, d\Delta.

    For a spectrum with a normal distribution of wavenumbers, of standard deviation :math:`\sigma_k = 2 \pi \cdot
    0.425 \, \Delta \lambda / \lambda^2`, and heights with a normal distribution of standard deviation h (the roughness)

    .. math:: M_\lambda = \sqrt{1 + 4 (2 h \sigma_k)^2}

    near normal incidence and reflection. The product :math:`M_s M_\lambda` is returned. Surfaces are assumed to scatter
    without volume and to keep the polarisation; a surface that depolarises has twice as many patterns.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, with a thin main lens.
    wavelength : float
        Mean wavelength in nanometres.
    distance : float
        Distance in millimetres of the surface from the main lens, which should be near the focus.
    source_diameter, source_distance : float, optional
        Diameter of an incoherent disc that illuminates the surface, and its distance from there, in millimetres.
        Default: a point.
    bandwidth : float
        Full width of the spectrum at half its maximum, in nanometres.
    roughness : float
        Root mean square height of the surface in millimetres. A bandwidth needs it.

    Returns
    -------
    float
        M, at least 1; `coherent_capture` takes an integer.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> camera = mp.PlenopticCamera()
    >>> m = mp.laser.mode_count(camera, wavelength=633, distance=240, source_diameter=10, source_distance=100)
    >>> round(m, 1)
    15.3
    """
    require_support(require_camera(camera), Use.COHERENT_POINTS)
    length = in_millimetres(require_wavelength(wavelength))
    distance = require_number("distance", distance, positive=True)
    size = require_number("source_diameter", source_diameter, minimum=0)
    width = in_millimetres(require_number("bandwidth", bandwidth, minimum=0))
    height = require_number("roughness", roughness, minimum=0)
    refuse_if(size > 0 and source_distance is None, "source_distance: a source_diameter needs it")
    refuse_if(width > 0 and height == 0, "roughness: a bandwidth needs it: a smooth surface has no speckle")
    modes = 1.0
    if size > 0:
        far = require_number("source_distance", source_distance, positive=True)
        # Small angular radii, in units of the smaller one, so that small ones do not vanish when they are squared.
        radii = (size / 2 / far, camera.aperture_radius / distance)
        source, pupil = (radius / min(radii) for radius in radii)
        # Nodes of the integral over angles.
        nodes, weights = np.polynomial.legendre.leggauss(400)
        step = nodes + 1
        overlap = _overlap(step / (2 * source)) * _overlap(step / (2 * pupil)) ** 2
        modes = float(source**2 / 2 / np.sum(weights * overlap * step))
    # Full width at half maximum of a normal distribution, over its standard deviation.
    spread = 2 * math.pi * width / (2 * math.sqrt(2 * math.log(2))) / length**2
    # 2.0: Sum of the cosines of incidence and reflection, both near the surface's normal.
    return modes * math.sqrt(1 + 4 * (2.0 * height * spread) ** 2)


def _overlap(shift: Doubles) -> Doubles:
    """Return the common part of two equal discs, by the distance of their centres over the diameter."""
    return 2 / math.pi * (np.arccos(shift) - shift * np.sqrt(1 - shift**2))
