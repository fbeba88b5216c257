"""Ray and wave captures of scenes, and estimates of their time and memory."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..choices import MODELS
from ..errors import InputError, advice, argument, refuse_if, require_choice, require_count, suggest_keywords, warn
from ..io import Capture
from ..optics import guards
from ..runtime import Array, BatchMap, Cost, Job, Progress, cost_of, lanes_reported, one_at_a_time, require_memory_for
from .load import KNOWN_PARAMETERS, as_scene, meet_moved, mitsuba_sentence
from .radiance import SceneLight, require_film, require_seen, warn_of_metres

if TYPE_CHECKING:
    from ..io import Checkpoint

MOST_SAMPLES = 2**24
"""Largest count of samples per pixel."""

_RAYS_PER_PASS = 2**24
"""Rays traced at once. Their random states take 16 bytes each, so that the paper's 4096 x 4096 pixels with one sample
each need 0.25 GiB in addition to the film."""

_SAMPLES_PER_PASS = 2**14
"""Dr.Jit gives blocks of so many rays to its threads; pixels of more samples would be shared by two of them."""

_version = functools.cache(importlib.metadata.version)

_OF_INTEGRATORS = (*KNOWN_PARAMETERS["plenoptic_wave"], *KNOWN_PARAMETERS["plenoptic_laser"])
"""Parameters that captures hand on to the integrators."""


@functools.partial(suggest_keywords, others=_OF_INTEGRATORS)
@one_at_a_time
def render_capture(
    scene: Any,
    *,
    sensor: int | Any = 0,
    model: str | None = None,
    spp: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
    batch_map: BatchMap | None = None,
    noise: bool = False,
    **wave: Any,
) -> Capture:
    """Return the capture of a plenoptic camera in a scene.

    Parameters
    ----------
    scene : mitsuba.Scene, str, path or dict
        A scene with a sensor of type ``plenoptic``, or what `load_scene` makes one of.
    sensor : int or mitsuba.Sensor
        Index of the sensor in the scene, counted from 0, or a sensor, which need not be in the scene.
    model : {"ray", "wave"}, optional
        Model of the light in the camera: ``wave`` makes the scene's integrator the child of a ``plenoptic_wave``,
        ``ray`` replaces a ``plenoptic_wave`` by its child. Default: that of the scene's integrator.
    spp : int, optional
        Samples per pixel, for both models; with method ``points``, points per microlens. Default: the sample count of
        the sensor's sampler. Ray captures draw them in passes of powers of two, each with a pattern of its own if the
        sampler has one.
    seed : int
        Seed of the random numbers; the same seed gives the same bits, with any thread count and in any process, except
        on CUDA.
    progress : callable, optional
        Called with the finished and the total amount of work, sometimes by another thread, while this one waits.
    checkpoint : Checkpoint, optional
        For wave captures: intermediate results are saved to its file, and read from there. Ray captures do not take
        one.
    batch_map : callable, optional
        For wave captures: computes the parts of the sums, for example `Cluster`. Default: threads of
        this process.
    noise : bool
        Whether to estimate also the standard deviation of the pixels from seed to seed, as `Capture.noise`. The value
        of each pixel has a relative error of 18 % or more. The estimate uses the spread of up to 16 passes and needs at
        least two samples; the image differs from that of a single pass, because the random numbers do. Wave captures
        thereby become up to a third noisier, or less noisy if pixels are coarse; the estimate is for captures with
        this option. Over dark or bright parts of a wave capture it is right within 10 %, within 20 % where
        `detector_blur` exceeds a pixel, but black pixels have none. A wave capture on a luminance film in an rgb
        variant gets the weighted sum of its channels' deviations: an upper bound, which is reached where the channels
        deviate together, as they do for grey objects.
    **wave
        Parameters of ``plenoptic_wave``: ``wavelength``, ``bandwidth``, ``responses``, ``wavelength_count``, ``nodes``,
        ``method``, ``accuracy``; or of the scene's ``plenoptic_laser``.

    Raises
    ------
    InputError
        If the scene is not of the active variant, has no such sensor or no integrator, a parameter is out of range,
        the capture would take more memory than is allowed, or a pixel is NaN or infinite.
    PhysicsError
        If too much of the light is lost. The fractions that the guards found are in the metadata under ``guards``.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> size = {"detector_width": 0.256, "resolution": 128}
    >>> scene = mp.load_scene("letters", variant="llvm_ad_mono", parameters=size)
    >>> capture = mp.render_capture(scene, spp=4)  # of a wave capture: model="wave"
    >>> capture.image.shape, capture.model
    ((128, 128), 'ray')
    """
    scene = as_scene(scene)
    chosen = plenoptic_sensor(scene, sensor)
    camera = PlenopticCamera.from_sensor(chosen)
    warn_of_metres(scene, chosen)
    if camera.lens_data.images_stop:
        from ..design import overlap_warnings

        for text in overlap_warnings(camera):
            warn(text)
    require_film(chosen.film())
    integrator = chosen_integrator(scene, model, wave)
    require_seen(integrator, chosen)
    if not hasattr(integrator, "wavelengths"):
        refuse_by_rays(checkpoint=checkpoint, batch_map=batch_map)
    spp = sample_count(chosen, spp)
    seed = require_count("seed", seed, minimum=0, maximum=2**32 - 1)
    refuse_if(noise and spp < 2, f"spp = {spp}: it must be at least 2 for an estimate of the noise")
    wavelengths = None
    spectrum = None
    if hasattr(integrator, "wavelengths"):
        spectrum = integrator.spectrum_of(scene, chosen)
        wavelengths = integrator.wavelengths if spectrum is None else spectrum.centroids()
    rows, columns = camera.shape
    require_memory_for(
        lambda width: film_memory(camera, spp, width),
        columns,
        f"capture of {columns} x {rows} pixels",
        lambda width: f"{width} x {max(1, round(width * rows / columns))} pixels",
        computed=True,
    )
    # Two sensors with the same camera must not share a checkpoint.
    label = {} if sensor == 0 else {"sensor": sensor if isinstance(sensor, int) else chosen.id()}
    metadata = {
        "scene": scene.id(),
        "variant": mi.variant(),
        "integrator": getattr(integrator, "child", integrator).class_name(),
        **(integrator.parameters() if hasattr(integrator, "parameters") else {}),
        "software": {name: _version(name) for name in ("mitsuba-plenoptic", "mitsuba", "drjit", "numpy")},
        "seed": seed,
        "spp": spp,
        **label,
    }
    deviation = None
    with guards.watch() as fractions:
        if wavelengths is None:
            guards.check(guards.CROSSTALK, chosen.crosstalk_missed())
            image, deviation = _render_passes(scene, chosen, integrator, camera, spp, seed, progress, noise)
        else:
            if checkpoint:
                checkpoint.run = {**metadata, "camera": camera.to_dict(), **({"noise": True} if noise else {})}
            job = Job(progress, batch_map, checkpoint)
            film = integrator.record(scene, chosen, seed=seed, spp=spp, job=job, noise=noise)
            image = np.array(film.develop())
            if noise:
                image, deviation = _split(image, film.base_channels_count())
    metadata["guards"] = fractions
    if spectrum is not None:
        metadata["spectrum"] = {"wavelengths": spectrum.wavelengths, "responses": spectrum.responses}
    if image.shape[2] == 1:
        image = image[..., 0]
        deviation = None if deviation is None else deviation[..., 0]
    if wavelengths is None:
        return Capture(image, camera, None, "ray", metadata, deviation)
    if len(set(wavelengths)) == 1:
        return Capture(image, camera, wavelengths[0], "wave", metadata, deviation)
    # A luminance film adds up three wavelengths, so that its capture has no single one.
    return Capture(image, camera, wavelengths if image.ndim == 3 else None, "wave", metadata, deviation)


def plenoptic_sensor(scene: Any, sensor: int | Any = 0) -> Any:
    """Return a scene's plenoptic sensor by its index, or a given sensor; refuse a scene of another variant."""
    require_active("scene", scene, mi.Scene)
    if hasattr(sensor, "variant_name"):
        require_active("sensor", sensor, mi.Sensor)
        meet_moved(scene, sensor)
        return sensor
    instead = advice(python="with_camera gives the scene one", shell="--camera NAME gives it one")
    refuse_if(not scene.sensors(), f"scene: it has no sensor; {instead}, or add one of type 'plenoptic'")
    chosen = numbered_sensor(scene, sensor)
    try:
        PlenopticCamera.from_sensor(chosen)
    except InputError as error:
        if plenoptic := [index for index, item in enumerate(scene.sensors()) if hasattr(type(item), "camera")]:
            instead = advice(python=f"sensor={plenoptic[0]} is one", shell=f"--sensor {plenoptic[0]} is one")
        raise InputError(f"{error}; {instead}") from None
    meet_moved(scene, chosen)
    return chosen


def require_active(name: str, thing: mi.Object, kind: type) -> mi.Object:
    """Return an object of a kind of the active variant; refuse others, and those of another variant."""
    variant = thing.variant_name() if hasattr(thing, "variant_name") else None
    refuse_if(
        not isinstance(thing, kind),
        f"{name} of type {type(thing).__name__}{f' and of variant {variant}' if variant else ''}: it must be a "
        f"mitsuba.{kind.__name__} of the active variant {mi.variant()}, which is one for the whole process: load the "
        "scene after mi.set_variant",
    )
    return thing


def numbered_sensor(scene: mi.Scene, index: int) -> mi.Sensor:
    """Return a scene's sensor by its index; refuse what is no index of one."""
    index = require_count("sensor", index, minimum=0)
    sensors = scene.sensors()
    refuse_if(index >= len(sensors), f"sensor = {index}: the scene's are numbered from 0 to {len(sensors) - 1}")
    return sensors[index]


def is_wave_capture(scene: Any, model: str | None) -> bool:
    """Return whether a capture is by waves: as `model` states, or by the scene's integrator if `model` is None."""
    return model == "wave" or (model is None and hasattr(scene.integrator(), "wavelengths"))


def refuse_by_rays(**given: Any) -> None:
    """Refuse arguments of wave captures that were given for a ray capture; None means not given."""
    for name, value in given.items():
        if value is not None:
            raise InputError(f"{argument(name)}: a ray capture does not take it; it is for {argument('model')} wave")


def require_wave_film(film: Any) -> None:
    """Refuse films that wave captures would not fill as the film describes."""
    require_film(film)
    refuse_if(
        film.class_name() != "HDRFilm",
        f"plenoptic_wave: film of type {film.class_name()}: it must be an hdrfilm; give responses to the integrator",
    )
    refuse_if(
        not film.rfilter().is_box_filter(),
        f"plenoptic_wave: the film's filter is {film.rfilter().class_name()}: pixels are integrated exactly, "
        'use <rfilter type="box"/>',
    )


def sample_count(sensor: Any, spp: int | None) -> int:
    """Return the requested number of samples, or the number of the sensor's sampler if it is None."""
    return require_count("spp", sensor.sampler().sample_count() if spp is None else spp, maximum=MOST_SAMPLES)


def chosen_integrator(scene: Any, model: str | None, wave: dict[str, Any]) -> Any:
    """Return the scene's integrator, wrapped into a wave integrator or taken out of one as the model requires.

    Integrators with extra outputs are refused.
    """
    integrator = scene.integrator()
    if integrator is None:
        raise InputError("scene: it has no integrator; add one, for example of type 'path'")
    if model is not None:
        require_choice("model", model, MODELS)
    is_wave = hasattr(integrator, "wavelengths")
    child = integrator.child if is_wave else integrator
    instead = advice(python="ground_truth(scene) returns depth and normals", shell="--aov writes depth and normals")
    extra = ", ".join(child.aov_names())
    refuse_if(extra, f"integrator: it has the extra outputs {extra}; a capture needs one without; {instead}")
    if model == "ray" or (model is None and not is_wave):
        refuse_by_rays(**wave)
        integrator = child
    elif wave or not is_wave:
        properties = {"type": integrator.plugin, **integrator.parameters()} if is_wave else {"type": "plenoptic_wave"}
        # None means not given; Mitsuba's loader would end the process on it.
        wave = {name: value for name, value in wave.items() if value is not None}
        try:
            integrator = mi.load_dict({**properties, **wave, "child": child})
        except RuntimeError as error:
            raise InputError(mitsuba_sentence(error)) from None
    return integrator


def film_memory(camera: PlenopticCamera, spp: int, columns: int) -> float:
    """Return the memory of a ray capture in bytes, for a film of the camera's aspect with `columns`."""
    pixels = float(columns) * max(1, round(columns * camera.shape[0] / camera.shape[1]))
    # Per pixel the block of red, green, blue and weight, the developed image, its copy, and the sum of passes,
    # each of up to four single-precision values; per ray a random state.
    return 4 * 4 * 4 * pixels + 16 * max(min(_RAYS_PER_PASS, pixels * spp), pixels)


def _split(image: Array, channels: int) -> tuple[Array, Array]:
    """Return the channels of a film's image and of its noise, both in the film's colours."""
    image, deviation = image[..., :channels], image[..., channels:]
    if channels < deviation.shape[2]:
        weights = [mi.luminance(mi.ScalarColor3f(unit)) for unit in np.eye(3).tolist()]
        deviation = deviation @ np.array(weights, np.float32)
    elif deviation.shape[2] < channels:
        # Light of one wavelength fills all channels of a colour film.
        deviation = np.repeat(deviation, channels, axis=2)
    return image, deviation


def estimate_capture(scene: Any, **options: Any) -> Cost:
    """Return the estimated time and memory of `render_capture` with the same arguments.

    The capture is begun, and abandoned as soon as its speed is known: some five seconds after the first results, or at
    its end.

    Parameters
    ----------
    scene, **options
        As in `render_capture`, without `progress` and `checkpoint`.

    Returns
    -------
    Cost
        Seconds, and bytes beside those of the program, the scene and the light's paths.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> scene = mp.load_scene("letters", variant="llvm_ad_mono", parameters={"resolution": 256})
    >>> cost = mp.estimate_capture(scene, spp=4)
    >>> cost.seconds < 60, cost.memory < 2**30
    (True, True)
    """
    return cost_of(render_capture, scene, **options)


def _render_passes(
    scene: Any,
    sensor: Any,
    integrator: Any,
    camera: PlenopticCamera,
    spp: int,
    seed: int,
    progress: Progress | None,
    noise: bool,
) -> tuple[Array, Array | None]:
    """Return the image, rendered in passes, whose memory does not grow with the samples, and the requested noise."""
    most = max(1, _RAYS_PER_PASS // (camera.shape[0] * camera.shape[1]))
    spread = None
    if noise:
        from ..detector import PARTS, PassSpread

        spread = PassSpread()
        most = min(most, 1 << (-(-spp // PARTS) - 1).bit_length())
    counts = pass_counts(sensor, spp, most)
    if noise and len(counts) == 1:
        counts *= 2
    # Runs with neighbouring seeds must not share passes, or their average would be no better than either of them.
    seeds = np.random.SeedSequence(seed).generate_state(len(counts))
    image = np.zeros(())
    sampler = sensor.sampler()
    count_before = sampler.sample_count()
    pixels = camera.shape[0] * camera.shape[1]
    rays = pixels * sum(counts)
    done = 0

    def report(fraction: float) -> None:
        if progress:
            progress(done + round(fraction * pixels * count), rays)

    if progress and isinstance(integrator, mi.SamplingIntegrator):
        # What Mitsuba evaluates as rays are first recorded, such as textures, would be counted as the kernel.
        SceneLight(scene, sensor, integrator)((0.0, 0.0, 0.0), (0.0, 0.0), mi.Bool(True), 0)
    try:
        for index, (pass_seed, count) in enumerate(zip(seeds.tolist(), counts, strict=True)):
            with lanes_reported(progress and report, pixels * count):
                # `integrator.render` rather than `mi.render`, which hides the cause of an error.
                rendered = np.array(integrator.render(scene, sensor, seed=pass_seed, spp=count, develop=True))
            if spread:
                spread.add(rendered, count)
            else:
                rendered *= count / sum(counts)
                image = np.add(image, rendered, out=image) if index else rendered
            report(1.0)
            done += pixels * count
    finally:
        # Passes leave their count in the scene's sampler, where the next capture would look for its own.
        sampler.set_sample_count(count_before)
    return (spread.image, spread.deviation()) if spread else (image, None)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Let Mitsuba report errors only, for what has been said or nobody has asked for."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(level)


def pass_counts(sensor: Any, spp: int, most: int) -> list[int]:
    """Return sample counts of passes, each a power of two and at most `most`, that add up to `spp`.

    Otherwise two threads may share a pixel, and the order in which they add samples varies. Samplers other than
    ``independent`` allow only some counts; their smallest allowed count is used for the smallest pass.
    """
    sampler = sensor.sampler().clone()

    def is_drawn(count: int) -> bool:
        sampler.set_sample_count(count)
        return bool(sampler.sample_count() == count)

    most = min(most, _SAMPLES_PER_PASS, spp)
    # Mitsuba warns of each count that a sampler does not allow.
    with quiet():
        sizes = [size for size in (2**k for k in reversed(range(_SAMPLES_PER_PASS.bit_length()))) if is_drawn(size)]
    counts: list[int] = []
    for size in [size for size in sizes if size <= most] or sizes[-1:]:
        counts += [size] * ((spp - sum(counts)) // size)
    # Samplers round up.
    return counts if sum(counts) == spp else [*counts, sizes[-1]]
