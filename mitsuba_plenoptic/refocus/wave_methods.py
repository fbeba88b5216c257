r"""Refocusing with the wave model: the square root of a capture is one coherent wave, or one for each lens subset.

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
light converges to there over z; and what is left after the microlens, :math:`\exp(-i \pi |m - c|^2 / \lambda a)`, makes
it converge once more, to :math:`\sqrt{I}` itself in the plane that the microlens sees, a before the MLA (or behind it)
with :math:`1/a + 1/z = 1/f_2`: the micro-image, enlarged, where the main lens's image is. Where micro-images are smooth
the light goes through a small part of the lens only, and what came from the rim of the pupil through the rim of a lens
misses the pupil on its way back; images are divided by what a white scene gives.

Partial coherence
-----------------
Light that passed different microlenses from different scene points never interferes, yet the fields of all lenses of a
coherent reconstruction do. Fields of lenses in subsets, every K-th column and row, interfere less; where the lenses of
a subset are farther apart than their images are wide, not at all. That limit is found by full fields with such a
period, or lens by lens, whichever costs less.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..light.optical_system import OpticalSystem
from .conjugates import RealConjugates, ThinConjugates, undistorted
from .full_fields import lit_window, reconstruct_subsets
from .lens_by_lens import LensTile, fine_bins, reconstruct_lens_by_lens, tile_lenses
from .methods import Progress, Task, method, portion, work_of
from .planning import plan
from .radiance import captures, lens_scale, over_lenses, to_radiance, white_sums

_APART = 2
"""Bins between the geometric images of two lenses that do not interfere, for diffraction."""


@method("coherent", options=("relay",), waves=True)
def coherent(task: Task, *, relay: bool) -> list[np.ndarray]:
    """Follow the light back as one coherent wave."""
    return _refocus(task, 1, relay)


@method("partial", options=("interleave", "relay"), waves=True)
def partial(task: Task, *, interleave: int | str, relay: bool) -> list[np.ndarray]:
    """Follow the light back as one wave for each subset of lenses, or for each lens."""
    return _refocus(task, interleave, relay)


def _refocus(task: Task, interleave: int | str, relay: bool) -> list[np.ndarray]:
    """Refocus every channel.

    The white that bins are divided by, if there is no white capture, is that of rays: without interference, less what
    waves lose of a micro-image at the edge of the pupil.
    """
    camera, oversample = task.camera, task.oversample
    sums = []
    for image, distances, progress in captures(task):
        # The shortest waves, which take the most memory, come first.
        channels = np.argsort(task.wavelengths[: image.shape[2]]).tolist()
        works, found = work_of([task.wavelengths[channel] for channel in channels]), {}
        for index, channel in enumerate(channels):
            system = task.system(task.wavelengths[channel])
            given = image[..., channel], system, distances, task.distances, interleave, relay, oversample
            found[channel] = _signed_power(*given, portion(progress, index, works))
        of_planes = zip(*(found[channel] for channel in sorted(found)), strict=True)
        sums.append([np.stack(planes, axis=-1) for planes in of_planes])
    white = [
        np.stack(
            [white_sums(camera, g, camera.lit_radius, "lens", oversample, w, relay) for w in task.wavelengths], axis=-1
        )
        for g in (task.distances if task.white is None else ())
    ]
    reach = [white_sums(camera, g, camera.lit_radius, "lens", oversample) for g in task.distances]
    return to_radiance(task, sums, white, reach)


def signed_parts(image: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Return the pixels that are not negative and, where there are others, the magnitudes of these, with their signs.

    Amplitudes are square roots. Pixels below zero, which `expose` makes of dark ones, are refocused apart, and what
    they give is subtracted: so noise of mean zero leaves no light on average.
    """
    if image.min() >= 0:
        return [(1.0, image)]
    return [(sign, np.maximum(sign * image, 0)) for sign in (1.0, -1.0)]


def _signed_power(
    image: np.ndarray,
    system: OpticalSystem,
    distances: Sequence[float],
    planned: Sequence[float],
    interleave: int | str,
    relay: bool,
    oversample: int,
    progress: Progress,
) -> list[np.ndarray]:
    """Return the power in bins, in pixel values times pixels, spread over lenses where these do not lie on bins.

    The propagation to the main lens is done once for all distances. Seen from behind, a real main lens is a thin one.
    Fields have the samples that all `planned` distances need: ratios of images, such as displacements, which are of
    single planes, are far more sensitive to the samples than the images are.
    """
    camera, wavelength = system.camera, system.wavelength
    fine, real, seen = fine_bins(system, oversample), None, camera
    planes, sampled = list(distances), list(planned)
    if camera.lens_data.traced_surfaces:
        real = RealConjugates.of(system, sampled, oversample)
        seen = real.camera
        planes, sampled = ([real.distance(distance) for distance in each] for each in (distances, planned))
    parts, found = signed_parts(image), [np.zeros(()) for _ in distances]
    for index, (sign, part) in enumerate(parts):
        # Guards look at the light, not at the noise below zero.
        options: dict[str, Any] = {"relay": relay, "oversample": oversample * fine, "checked": sign > 0}
        options |= {
            "progress": portion(progress, index, [1] * len(parts)),
            "conjugates": real or ThinConjugates(system),
        }
        period = full_field_period(part, seen, planes, wavelength) if isinstance(interleave, str) else interleave
        if period is None:
            totals = reconstruct_lens_by_lens(part, seen, planes, wavelength, **options)
        else:
            totals = reconstruct_subsets(part, seen, planes, wavelength, interleave=period, planned=sampled, **options)
        for plane, (total, distance) in enumerate(zip(totals, distances, strict=True)):
            scale = lens_scale(camera, distance)
            if real is not None:
                total, stretch = undistorted(total, real, camera, distance, oversample * fine)
                scale *= stretch
            if fine > 1 or real is not None:
                total = over_lenses(total, camera, oversample, fine, scale)
            found[plane] = found[plane] + sign * total
    return found


def full_field_period(
    image: np.ndarray, camera: PlenopticCamera, distances: Sequence[float], wavelength: float
) -> int | None:
    """Return the period from which subsets of lenses do not interfere, or None if single lenses are cheaper.

    Full fields are cheaper near focus, where few subsets suffice. The cost is the count of transformed samples.
    """
    lit = lit_window(image, camera)
    if lit is None:
        return 1
    blur = max(camera.blur_diameter(g) for g in distances) / min(camera.mla_pitches)
    period = math.ceil(blur - 1e-6) + _APART
    tile = LensTile(camera, wavelength, tile_lenses(camera, distances), 1)
    lenses = math.prod((end - first) / camera.pixels_per_lens for first, end in lit)
    single = lenses * tile.transformed * len(distances)
    # A field takes at least this; how much more needs grids, of which those of large cameras are not worth planning.
    if period**2 * math.prod(end - first for first, end in lit) >= single:
        return None
    return period if period**2 * plan(camera, wavelength, distances, lit).transformed < single else None
