"""`reconstruct`: the steps common to all methods, from the capture to the results."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Sequence
from typing import Any, overload

import numpy as np

from .. import design
from ..camera import PlenopticCamera, require_support
from ..errors import LONGEST, require_count, suggest_keywords, warn
from ..io import Capture, CaptureLike, Checkpoint, read_if_path
from ..optics import guards
from ..refocus_options import all_options, with_options
from ..runtime import GIB, BatchMap, Forecast, Named, Progress, in_words, memory_asked, one_at_a_time
from .displacement import is_known
from .methods import (
    Found,
    RegisteredMethod,
    Task,
    as_capture,
    portion,
    registered,
    require_distances,
    require_image_memory,
    require_option,
    require_response,
    require_wavelengths,
    used_by,
    work_of,
)
from .radiance import as_reference, computed_white, white_of_response
from .results import Reconstruction, Reconstructions
from .straight import displaced_image, passed_light, straightened, straightened_image

_log = logging.getLogger(__name__)

_PROGRESS_STEPS = 1000

_LONG = 30.0
"""Seconds from which on the time and memory of a reconstruction are told as soon as they are known."""


@overload
def reconstruct(capture: CaptureLike, distance: float, **options: Any) -> Reconstruction: ...
@overload
def reconstruct(capture: CaptureLike, distance: Sequence[float], **options: Any) -> Reconstructions: ...
@suggest_keywords
@one_at_a_time
@with_options
def reconstruct(
    capture: CaptureLike,
    distance: float | Sequence[float],
    *,
    method: str = "ray",
    camera: PlenopticCamera | None = None,
    wavelength: float | Sequence[float] | None = None,
    oversample: int = 1,
    white: CaptureLike | None = None,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
    batch_map: BatchMap | None = None,
    **options: Any,
) -> Reconstruction | list[Reconstruction]:
    """Refocus a capture to one or several object distances.

    Images of all methods are in units of radiance: each bin is divided by the light that it receives from a white
    scene, also at the borders. Bins that receive less than 1 % of the rays of the best bin are NaN.

    Parameters
    ----------
    capture : Capture, (rows, columns[, channels]) array, or path
        The capture, or a file that `read_capture` takes. A plain array needs `camera`.
    distance : float or sequence of floats
        Object distances in scene units, beyond the focal length. They may be infinite, where bins are directions.
        Several distances share the propagation to the main lens. For an objective: depths beyond its native object
        plane.
    method : {"ray", "coherent", "partial", "incoherent", "deconvolved"}
        ``ray`` traces one ray per pixel back to the object plane. ``coherent`` propagates back one coherent wave, whose
        amplitude is the square root of the capture. ``partial`` propagates one such wave for each interleaved
        subset of lenses, and adds their intensities. Waves pass the lenses as thin parabolic phases.
        ``incoherent`` propagates each point of the object by itself through this camera, and weighs the capture with
        its point spread (see `mitsuba_plenoptic.extensions.deconvolution.incoherent`).
        ``deconvolved`` finds the plane, or the planes, whose capture by this camera is the recorded one.
    camera : PlenopticCamera, optional
        The camera of a plain array, or one that replaces the capture's.
    wavelength : float or three floats, optional
        For the wave model: wavelength in nanometres, or one for each of three channels. Default: the capture's own. Ray
        methods take none.
    oversample : int
        Bins per lens along each axis. A focused camera resolves more than one:
        `mitsuba_plenoptic.design.suitable_oversample` and ``mitsuba-plenoptic info`` say how many.
    white : Capture, array or path, optional
        A capture of a uniform white field that fills the view, by the same camera at the same wavelengths, with one
        channel or as many as the capture has. It is scaled to a radiance of 1, channel by channel, so that images
        stay in units of the capture (see `mitsuba_plenoptic.views.white.recorded_white`). It is refocused by the
        same method, and images are divided by it. For unfocused cameras with thin main lenses, displacements of the
        light by borders, diffraction and interference are also corrected to first order (see
        `mitsuba_plenoptic.refocus.displacement`). This takes the time of one refocusing for the white and of two
        more for each distance. Default: the white image of the capture's model of light, computed, refocused likewise,
        and kept with the camera; a capture whose model is not known counts as one by rays.
        With ``deconvolved`` it shows what of its light each pixel records, over that of the camera's response: images
        are not divided by it, and pixels at which it is far from the response, behind dust, are left out.
    progress : callable, optional
        Called with the finished and the total count of steps.
    checkpoint : Checkpoint, optional
        For ``deconvolved``: intermediate results are saved to its file, and read from there.
    batch_map : callable, optional
        For ``deconvolved``: computes the point spreads, for example `Cluster`. Default: threads of this
        process.
    **options
        Options of single methods: see `mitsuba_plenoptic.refocus_options`.

    Returns
    -------
    Reconstruction or list of Reconstruction
        One for a single distance, a list for a sequence.

    Raises
    ------
    InputError
        If there is no camera, or no wavelength for a wave method; if the array does not fit the camera or holds NaN or
        infinity; for a wave method, if pixels are wider than lenses; or if an option is out of range.
    PhysicsError
        If hardly any of a capture's light passes back through the main lens in the wave model, or too much of it misses
        the object plane's window.

    Warns
    -----
    UserWarning
        If a distance is so far outside the range of refocusing that less than half a sample per lens is resolved; if
        the method has no use for an option, which other methods have, so that one call serves a loop over methods.

    Notes
    -----
    Wave methods refocus pixels below zero, as `expose` makes them, by their magnitude and subtract the result: noise of
    mean zero leaves no light on average.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> capture = mp.example("letters-wave")
    >>> near, far = mp.reconstruct(capture, [210, 280])
    >>> near.distance, near.image.shape, round(near.bin_size, 3)
    (210.0, (48, 48), 0.112)
    >>> far = mp.reconstruct(capture, 280, method="partial", interleave=2)
    """
    # Read.
    recorded = read_if_path(capture, camera)
    reference = read_if_path(white, camera)
    original = as_capture(recorded, camera)

    # Check.
    chosen = registered(method)
    tilted = original.camera
    require_support(tilted, chosen.use)
    # A method that knows aberrations knows unequal lenses, too, and divides by what it computes.
    as_recorded = chosen.as_recorded or (chosen.as_it_is and reference is None)
    capture = original
    if not as_recorded:
        # As lenses without displacement and of equal brightness would have recorded it.
        image = straightened_image(np.atleast_3d(original.image), tilted)
        image = image.reshape(original.image.shape)
        capture = dataclasses.replace(original, camera=straightened(tilted), image=image)
    image = np.atleast_3d(capture.image)
    camera = capture.camera
    options_used = used_by(
        chosen,
        white=reference,
        wavelength=wavelength,
        **{name: options.get(name) for name in all_options()},
        checkpoint=checkpoint,
        batch_map=batch_map,
    )
    reference = options_used["white"]
    wavelength = options_used["wavelength"]
    settings = {
        name: require_option(option, name, options_used[name], camera) for name, option in chosen.options.items()
    }
    if "response" in settings:
        settings["response"] = require_response(settings["response"], capture, wavelength)
    oversample = require_count("oversample", oversample)
    distances = require_distances(distance, camera)
    waves = chosen.waves and settings.get("response") != "ray"
    if chosen.waves:
        camera.require_resolved()
        if not chosen.as_it_is and camera.wavefront:
            # Images are formed by the lens as it should be.
            camera = camera.replace(wavefront=())
    facts = _resolutions(camera, distances, capture.wavelength, chosen)
    require_image_memory(camera, distances, oversample, image.shape, reference is not None and is_known(camera))
    wavelengths = require_wavelengths(capture, wavelength, image.shape[2], camera) if waves else []

    with memory_asked() as sizes:
        # Prepare.
        if reference is not None:
            reference = as_reference(reference, capture, tilted, recorded, as_recorded)
        report = _reports(chosen, progress, sizes)
        works = _works(chosen, capture, len(distances), settings)
        computed = None
        # Responses by rays have the white image of rays, and Fourier microscopes have none.
        if reference is None and not chosen.as_it_is:
            computed = computed_white(original, portion(report, 0, works))
        elif reference is None and waves and capture.model == "wave" and camera.lens_data.converges:
            computed = white_of_response(original, portion(report, 0, works))
        recorded_at = None
        if capture.model == "wave" and capture.wavelength is not None:
            recorded_at = np.broadcast_to(capture.wavelength, image.shape[2]).tolist()
        task = Task(
            image=image,
            camera=camera,
            distances=distances,
            oversample=oversample,
            wavelengths=wavelengths,
            white=reference,
            computed=computed,
            progress=portion(report, 1, works),
            passed=None if as_recorded else passed_light(tilted),
            recorded=recorded_at,
            exposure=capture.metadata.get("exposure"),
            checkpoint=options_used["checkpoint"],
            batch_map=options_used["batch_map"],
        )

        # Run.
        with guards.watch() as lost:
            images = _refocused(task, chosen, settings)

    # Describe.
    settings |= {"oversample": oversample} | ({"wavelength": wavelengths} if waves else {})
    settings |= {"white": "capture"} if reference is not None else {}
    results = []
    for value, fact, image_at in zip(distances, facts, images, strict=True):
        values = displaced_image(image_at.image, tilted, oversample)
        result = Reconstruction(
            image=values.reshape(*values.shape[:2], *capture.image.shape[2:]),
            distance=value,
            bin_size=camera.bin_size(1.0 if math.isinf(value) else value) / oversample,
            method=method,
            camera=straightened(camera),
            options=settings,
            guards=lost,
            facts={"model": capture.model, **fact, **image_at.facts},
        )
        results.append(result)
    return results[0] if np.ndim(distance) == 0 else Reconstructions(results)


def _resolutions(
    camera: PlenopticCamera, distances: Sequence[float], wavelength: Any, chosen: RegisteredMethod
) -> list[Named]:
    """Return facts on distances: whether they are in the range of refocusing, and the samples resolved per lens."""
    if not camera.lens_data.converges:
        return [{} for _ in distances]
    longest = None if wavelength is None else float(np.max(wavelength))
    near, far = design.refocus_range(camera, longest)
    facts = []
    blurred = {}
    for distance in distances:
        in_range = near <= distance <= far
        samples = design.effective_resolution(camera, min(distance, LONGEST), longest).samples_per_lens
        facts.append({"in_range": in_range, "samples_per_lens": samples})
        # 0.5: below, images show hardly anything, which deconvolution alone may undo.
        if not chosen.as_it_is and not in_range and samples < 0.5:
            blurred[f"{distance:g}"] = samples
    if blurred:
        by_waves = "" if longest is None else f" at {longest:g} nm"
        warn(
            f"distance = {', '.join(blurred)}: far outside the range of refocusing{by_waves}, {near:.4g} to {far:.4g} "
            f"mm: at most {max(blurred.values()):.2g} samples per lens are resolved there"
        )
    return facts


def _works(chosen: RegisteredMethod, capture: Capture, planes: int, settings: Named) -> list[float]:
    """Return the amounts of work of the white image and of the method."""
    if capture.model != "wave":
        return [0, 1]
    if chosen.as_it_is:
        # A white image by waves takes as long as a response, and a fifth of a deconvolution.
        return [1, 5 if chosen.long else 1]
    # Approximate seconds of the processor; "auto" takes as long as twenty subsets of lenses.
    period = settings.get("interleave", 1)
    subsets = 20 if period == "auto" else period**2
    size = capture.image.size
    return [1.0 + 7e-7 * size, planes * size * (1.2e-7 * subsets if chosen.waves else 5e-8)]


def _reports(chosen: RegisteredMethod, progress: Progress | None, sizes: Sequence[float]) -> Callable[[float], None]:
    """Return what is called with the fraction done; once it can be estimated, long work says its time and memory."""

    def tell(seconds: float) -> None:
        if seconds > _LONG:
            needed = f"{in_words(seconds)} and {max(sizes, default=0) / GIB:.2g} GiB"
            cheaper = "; method ray takes a small part of that" if chosen.waves else ""
            _log.info("method %s takes about %s%s", chosen.name, needed, cheaper)

    forecast = Forecast(tell, progress)
    reported = -1

    def report(done: float) -> None:
        nonlocal reported
        if (step := round(done * _PROGRESS_STEPS)) != reported:
            reported = step
            forecast(step, _PROGRESS_STEPS)

    report(0)
    return report


def _refocused(task: Task, chosen: RegisteredMethod, settings: Named) -> list[Found]:
    """Return a method's results at each distance, by each channel's camera if the cameras of channels differ."""
    tasks = [task]
    # Methods that compare with computed captures ask for each wavelength's camera themselves.
    if not chosen.as_it_is and (task.camera.glass is not None or task.camera.mla_glass is not None):
        wavelengths = task.wavelengths or task.recorded or []
        works = work_of(wavelengths)
        tasks = [
            dataclasses.replace(
                task,
                progress=portion(task.progress, channel, works),
                image=np.ascontiguousarray(task.image[..., channel : channel + 1]),
                camera=task.camera.at_wavelength(wavelength),
                wavelengths=task.wavelengths[channel : channel + 1],
                recorded=None if task.recorded is None else task.recorded[channel : channel + 1],
                white=None if task.white is None else np.ascontiguousarray(task.white[..., channel : channel + 1]),
                computed=None
                if task.computed is None
                else np.ascontiguousarray(task.computed[..., channel : channel + 1]),
            )
            for channel, wavelength in enumerate(wavelengths)
        ] or tasks
    by_task = [
        [plane if isinstance(plane, Found) else Found(plane) for plane in chosen.refocus(task_of_channel, **settings)]
        for task_of_channel in tasks
    ]
    if len(by_task) == 1:
        return by_task[0]
    return [
        dataclasses.replace(
            of_distance[0], image=np.concatenate([np.atleast_3d(plane.image) for plane in of_distance], 2)
        )
        for of_distance in zip(*by_task, strict=True)
    ]
