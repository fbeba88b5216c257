r"""The resolution that can be reached out of focus by inverting the camera's response.

A point out of focus lights many lenses, each of which sees it from elsewhere at another phase of the pixels. At the
defocus s (see `PlenopticCamera.defocus`) two things limit their joint resolution: the diffraction of a microlens of the
width w, and a pixel of the width p, both seen in the object plane at g,

.. math:: \nu_w = \frac{w}{0.94 \, \lambda \, |s| g}, \qquad \nu_p = \frac{z}{2 \, b p \, |s|} \frac{b}{g}

With the distance d from the plane in focus at :math:`g_0` and :math:`M = b / g_0`, :math:`|s| g = M d`: the first is
:math:`w / 0.94 \lambda M d` of Broxton et al. (2013, "Wave optics theory and 3-D deconvolution for the light field
microscope", Optics Express 21, 25418), the second :math:`1 / (2 (b p / z) d / g_0)`.

Near focus all lenses see the same, and the lens pitch decides; Broxton's formula holds from
:math:`d = w^2 / 2 M^2 \lambda` on.

This is the limit of single lenses, and of captures with noise. Light from the borders of neighbouring lenses meets on
the detector and interferes: of lines up to 1.5 times as fine, 1 to 3 % of the contrast arrives, enough without noise
(`tools/bench/cases/deconvolution.py`).

In the Fourier arrangement each lens sees the whole object, through its own part of the stop of the width
:math:`M w / f_F`, which is twice its numerical aperture. The lens transmits lines up to
:math:`\nu_c = M w / f_F \lambda`. At the depth d its defocus, a blur of the width :math:`\beta = M w |d| / n f_F`,
extinguishes lines from the first zero of its transfer function on: for straight edges
:math:`\beta \nu (1 - \nu / \nu_c) = 1` there (Goodman, "Introduction to Fourier Optics", section 6.4.4). Pixels are
equally wide in the object at all depths.
"""

import math
from dataclasses import dataclass

from ..camera import PlenopticCamera
from ..errors import require_number, require_wavelength
from ..optics import in_millimetres
from ..prescription import Objective, image_distance
from .quantities import pixel_footprint

_SPARROW = 0.94
"""Distance of two points that are just resolved (Sparrow), over wavelength and aperture."""


@dataclass(frozen=True)
class ResolutionLimit:
    """The finest lines, in line pairs per scene unit, that deconvolution resolves in a plane.

    Attributes
    ----------
    waves : float
        Limit by the diffraction of a microlens; infinite in focus, and where there is no wavelength.
    pixels : float
        Limit by the pixels; infinite in focus.
    lenses : float
        Limit by one sample per lens, as in reconstructions without deconvolution; in the Fourier arrangement, where
        each lens makes a picture, by one sample per pixel.
    in_focus : bool
        Whether the plane is so near focus that lenses see the same: the pitch of the lenses decides.
    frequency : float
        The limit: the lowest of `waves` and `pixels`; in focus, `lenses`. Without noise deconvolution goes up to 1.5
        times as far.
    """

    waves: float
    pixels: float
    lenses: float
    in_focus: bool

    @property
    def frequency(self) -> float:
        """Lower of the two limiting frequencies, in line pairs per scene unit; near focus that of the lens pitch."""
        return self.lenses if self.in_focus else min(self.waves, self.pixels)


def resolution_limit(camera: PlenopticCamera, distance: float, wavelength: float | None = None) -> ResolutionLimit:
    """Return the resolution that deconvolution can reach in a plane.

    Parameters
    ----------
    distance : float
        Object distance from the main lens in millimetres, or depth beyond an objective's native object plane; at
        infinity line pairs count per unit of slope.
    wavelength : float, optional
        Wavelength in nanometres. By default diffraction is neglected; a plane is then in focus if its blur is below one
        lens.

    Returns
    -------
    ResolutionLimit
    """
    if wavelength is not None:
        camera = camera.at_wavelength(require_wavelength(wavelength))
    objective = camera.objective
    if objective is not None:
        behind = _in_the_stops_image if objective.images_stop else _behind_objective
        return behind(camera, objective, require_number("distance", distance), wavelength)
    image_distance(camera.focal_length, require_number("distance", distance, finite=False))
    b = camera.mla_distance
    defocus = abs(camera.defocus(distance))
    # From the MLA, seen from the main lens's centre, to the object plane.
    scale = 1.0 if math.isinf(distance) else distance
    width = camera.lattice.aperture_width
    pixel = pixel_footprint(camera, distance) * scale / b
    pixels = 1 / (2 * pixel) if pixel > 0 else math.inf
    waves = math.inf
    shallow = max(camera.mla_pitches)
    in_focus = camera.blur_diameter(distance) < shallow
    if wavelength is not None:
        lam = in_millimetres(wavelength)
        waves = width / (_SPARROW * lam * defocus * scale) if defocus > 0 else math.inf
        focus = camera.focus_distance
        # Where no plane is in focus at a finite distance, from the image: its distance from the MLA is M^2 d.
        image = image_distance(camera.focal_length, distance)
        depth = abs(scale - focus) * (b / focus) ** 2 if 0 < focus < math.inf > distance else defocus * image
        in_focus = depth < width**2 / (2 * lam)
    return ResolutionLimit(waves, pixels, b / (2 * max(camera.mla_pitches) * scale), in_focus)


def _behind_objective(
    camera: PlenopticCamera, lens: Objective, depth: float, wavelength: float | None
) -> ResolutionLimit:
    r"""Return the limit of a microscope, :math:`n w / 0.94 \lambda M d` or :math:`n z / 2 M p d`, at most 2 NA."""
    M = lens.magnification
    n = lens.immersion
    d = abs(depth)
    width = camera.lattice.aperture_width
    pixels = n * camera.reduced_distance / (2 * M * camera.pixel_size * d) if d > 0 else math.inf
    waves = math.inf
    in_focus = camera.blur_diameter(depth) < max(camera.mla_pitches)
    if wavelength is not None:
        lam = in_millimetres(wavelength)
        waves = min(n * width / (_SPARROW * lam * M * d) if d > 0 else math.inf, 2 * lens.numerical_aperture / lam)
        in_focus = d < n * width**2 / (2 * M * M * lam)
    return ResolutionLimit(waves, pixels, M / (2 * max(camera.mla_pitches)), in_focus)


def _in_the_stops_image(
    camera: PlenopticCamera, lens: Objective, depth: float, wavelength: float | None
) -> ResolutionLimit:
    """Return the resolution limit of the Fourier arrangement, which excludes no range around the plane in focus."""
    pixels = 1 / (2 * camera.bin_size(depth))
    waves = math.inf
    aperture = lens.magnification * camera.lattice.aperture_width / lens.last_focal_length
    blur = aperture * abs(depth) / lens.immersion
    if wavelength is not None:
        cutoff = aperture / in_millimetres(wavelength)
        inner = 1 - 4 / (blur * cutoff) if blur > 0 else -1.0
        waves = cutoff if inner < 0 else 2 / blur / (1 + math.sqrt(inner))
    elif blur > 0:
        waves = 1 / blur
    return ResolutionLimit(waves, pixels, pixels, False)
