r"""Incoherent reconstruction: every object point is treated separately, and its pattern correlated with the capture.

A bin k of the object plane, of radiance 1 and without light from elsewhere, has the capture :math:`a_k`: the sum of the
point spreads of its points, whose light does not interfere. A bin's value is the capture I weighted by this pattern,
divided by a white capture W weighted likewise,

.. math:: x_k = \frac{\langle a_k, I \rangle}{\langle a_k, W \rangle} .

This is the normalised adjoint of the capture :math:`I = \sum_k a_k x_k`, also known as back-projection, and in radar as
the matched filter (Turin, IRE Trans. Inf. Theory 6, 311 (1960)). `ray` does the same with the geometric images of the
bins. Neither two lenses nor two points of the object interfere, and the result is linear in the capture. The result is
blurred by the autocorrelation of each point spread, which `deconvolved` removes. Patterns are those before the
`detector_blur`, which would widen that further; only white has it.

Point spreads that differ by a shift of whole lenses are computed once for a zone of lenses
(`mitsuba_plenoptic.extensions.deconvolution.response`).
"""

import dataclasses

import numpy as np

from ...detector import SHARP, DetectorOperator
from ...refocus import Task, captures, method, portion, straightened, to_radiance, white_pixels, white_sums, work_of
from ...runtime import Job
from .fourier import response_of


@method("incoherent", waves=True, as_it_is=True)
def refocus(task: Task) -> list[np.ndarray]:
    """Return the capture weighed with the capture of every single bin.

    There is one response per plane and wavelength, for all channels of this wavelength. The computed white is that of
    the capture's own model: a ray capture has lost no light to diffraction.
    """
    camera = task.camera
    lights = sorted(set(task.wavelengths))
    images = []
    for plane, distance in enumerate(task.distances):
        plane_task = dataclasses.replace(task, distances=[distance])
        images_of_plane = [image for image, _, _ in captures(plane_task)]
        # For each channel the bins of the captures and of white.
        bins: list[list[np.ndarray]] = [[] for _ in task.wavelengths]
        for index, wavelength in enumerate(lights):
            channels = np.flatnonzero(np.equal(task.wavelengths, wavelength))
            progress = portion(portion(task.progress, plane, [1] * len(task.distances)), index, work_of(lights))
            with response_of(camera)(
                camera.replace(**SHARP),
                plane_task.distances,
                wavelength=wavelength,
                oversample=task.oversample,
                job=Job(progress=lambda done, total, progress=progress: progress(done / total)),  # type: ignore[misc]
                steps=len(channels) * (len(images_of_plane) + 1) / 2,
            ) as response:
                whites = []
                # Else it is one of the captures.
                if task.computed is None:
                    by_waves = task.recorded is not None or not camera.lens_data.converges
                    ones = np.ones(response.source_shape, np.float32)
                    whites = [
                        DetectorOperator.of(camera).forward(response.forward(ones))
                        if by_waves
                        else white_pixels(camera)
                    ]
                for channel in channels:
                    pixels = [*(image[..., channel] for image in images_of_plane), *whites]
                    bins[channel] = [
                        response.to_image(response.adjoint(np.ascontiguousarray(some, np.float32)), 0)
                        for some in pixels
                    ]
        *sums, divisor = (np.stack(parts, axis=-1) for parts in zip(*bins, strict=True))
        if camera.lens_data.converges:
            # As for all methods, bins that hardly any ray reaches are NaN, though light is diffracted there.
            seen = white_sums(straightened(camera), distance, camera.lit_radius, "lens", task.oversample)
        else:
            seen = divisor.mean(-1)
        images += to_radiance(plane_task, [[total] for total in sums], [divisor], [seen])
    return images
