"""The experiment behind every report: one scene captured by rays and by waves, and refocused by every method."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera, Use, is_supported, require_support
from ..capture_spec import CaptureSpec
from ..choices import Against
from ..errors import naming, refuse_if, require_choice
from ..extension import hook
from ..io import Cache, Capture, Checkpoint, StageOptions
from ..optics import RGB_WAVELENGTHS
from ..plugins.other_camera import with_camera
from ..refocus import Reconstruction, header_of, reconstruct, require_distances
from ..runtime import Array, Facts, Named, Numbers, Pair, Progress, in_words
from .images import luminance
from .photographs import pinhole_image, thin_lens_image

_log = logging.getLogger(__name__)


OBJECT_COLUMNS = 1024


class RefocusMethod(NamedTuple):
    """A refocusing method: name, title in figures, options of `reconstruct`, and the capture that it refocuses."""

    name: str
    title: str
    options: Named
    source: str = "wave"


_METHODS: dict[str, tuple[str, Named]] = {
    "ray": ("Rays", {"method": "ray", "footprint": "lens"}),
    "coherent": ("Coherent", {"method": "coherent"}),
    "partial": ("Partially coherent", {"method": "partial", "interleave": 2}),
    "incoherent": ("Incoherent", {"method": "incoherent"}),
    "deconvolved": ("Deconvolved", {"method": "deconvolved"}),
}
"""Titles and options of the methods of `reconstruct`."""

COMPARED_METHODS = (
    RefocusMethod("ray_of_ray", "Rays, of the ray capture", _METHODS["ray"][1], "ray"),
    RefocusMethod("ray_point", "Rays, one bin a pixel", {"method": "ray", "footprint": "point"}),
    RefocusMethod("ray", "Rays, lens footprint", _METHODS["ray"][1]),
    *(RefocusMethod(name, *_METHODS[name]) for name in ("coherent", "partial")),
    # The limit in which no two lenses interfere.
    RefocusMethod("limit", "One lens at a time", {"method": "partial", "interleave": "auto"}),
)
"""Methods that the paper compares."""


def methods_of_both(names: Sequence[str]) -> tuple[RefocusMethod, ...]:
    """Return methods of the ray and of the wave capture, rays always; last the limit, of the wave capture, if named."""
    for name in names:
        require_choice("methods", name, (*_METHODS, "limit"))
    both = []
    for name, (title, options) in _METHODS.items():
        if name in ("ray", *names):
            both += [
                RefocusMethod(f"{name}_of_ray", f"{title}, ray capture", options, "ray"),
                RefocusMethod(name, title, options),
            ]
    return (*both, *(method for method in COMPARED_METHODS if method.name == "limit" and "limit" in names))


_PRICES = {"ray": 0.05, "coherent": 0.15, "partial": 0.3, "incoherent": 0.0, "deconvolved": 2.0, "limit": 4.5}
_STEPS = {"incoherent": 1.5, "deconvolved": 30.0}
"""Seconds of two cores, by method, for a million pixels at a distance, or the steps with a response, which has one."""

METHOD_TITLES = {
    "truth": "Ideal lens (truth)",
    **{method.name: method.title for method in (*methods_of_both(tuple(_METHODS)), *COMPARED_METHODS)},
}

# Those of the paper that its report's slider shows; the others differ in details only and the last one takes long.
SLIDER_METHODS = ("ray", "coherent", "partial")

ORDINARY = "ordinary"
"""Name of the camera without a microlens array, and of its pictures."""

EDGE_TILT = math.radians(5)
"""Angle of slanted edges, on which sharpness is measured, against the pixels."""


@dataclass(frozen=True)
class Settings(CaptureSpec):
    """A capture, made by rays and by waves in a variant of one colour, and what it is refocused to and compared with.

    Attributes
    ----------
    distances : tuple of float
        Distances of the figures and metrics, where all methods are used, in millimetres.
    slider : tuple of float
        Distances of the report's slider, in millimetres.
    camera_name : str, optional
        What the command calls the camera that replaces the scene's.
    wavelength : float
        Wavelength in nanometres; in colour that of figures of the design, as captures have three of their own.
    methods : tuple of RefocusMethod
        What the captures are refocused by.
    points : int, optional
        Points per lens of another wave capture, point by point, with which the one from signed rays is compared.
        Default: no such capture.
    truth_spp : int
        Samples per pixel of the thin lens.
    noise : bool
        Whether the captures keep the noise of their samples, which takes two of each at least.
    pdf : bool
        Whether figures are written as PDF, too, for papers.
    """

    wavelength: float = 633.0
    spp: int = 16
    distances: Numbers = ()
    slider: Numbers = ()
    camera_name: str | None = None
    methods: tuple[RefocusMethod, ...] = COMPARED_METHODS
    points: int | None = None
    truth_spp: int = 1024
    noise: bool = False
    pdf: bool = True

    @property
    def slider_methods(self) -> tuple[str, ...]:
        """Names of the wave capture's methods whose pictures the slider of the report shows."""
        waves = [method.name for method in self.methods if method.source == "wave"]
        return tuple(name for name in waves if name not in ("limit", "ray_point"))


@dataclass(frozen=True)
class Ordinary:
    """A scene by the camera without its microlens array, and a slanted edge in focus by both cameras."""

    capture: Capture
    # Distance in focus, of the edge as well.
    distance: float
    # The edge by the ordinary camera, under its name, and by the methods that refocus a capture of it.
    edges: dict[str, Array]


# Reconstructions by method and distance.
Images = dict[tuple[str, float], Array]


@dataclass(frozen=True)
class Experiment:
    """Captures and reconstructions of an experiment."""

    settings: Settings
    camera: PlenopticCamera
    ray: Capture
    wave: Capture
    # The wave capture point by point.
    points: Capture | None
    wave_key: str
    # Thin-lens image by distance.
    truths: dict[float, Array]
    images: Images
    # The scene from the centre of the main lens.
    pinhole: Array
    # Bounding boxes of the scene's shapes in the camera's frame by id.
    boxes: dict[str, Pair]
    # How long each stage took.
    seconds: dict[str, float]
    # What the captures are compared with besides each other.
    ordinary: Ordinary | None

    @property
    def light(self) -> str:
        """The wavelengths of the wave capture in nanometres, as text."""
        return ", ".join(f"{length:g}" for length in np.array(self.wave.wavelength).ravel())

    def grey(self) -> Experiment:
        """Return the experiment with the luminance of all images, in which colours are measured."""

        def of_capture(capture: Capture) -> Capture:
            wavelength = None if capture.wavelength is None else self.settings.wavelength
            return _changed(capture, luminance, wavelength=wavelength)

        if self.ray.image.ndim == 2:
            return self
        ordinary = self.ordinary and replace(
            self.ordinary,
            capture=of_capture(self.ordinary.capture),
            edges={name: luminance(image) for name, image in self.ordinary.edges.items()},
        )
        return replace(
            self,
            ray=of_capture(self.ray),
            wave=of_capture(self.wave),
            points=self.points and of_capture(self.points),
            truths={distance: luminance(image) for distance, image in self.truths.items()},
            images={key: luminance(image) for key, image in self.images.items()},
            pinhole=luminance(self.pinhole),
            ordinary=ordinary,
        )

    def image(self, method: str, distance: float) -> Array:
        """Return the reconstruction by a method at a distance, or for ``truth`` the thin lens's image."""
        return self.truths[distance] if method == "truth" else self.images[method, distance]


def run_experiment(
    settings: Settings,
    store: Cache,
    against: str | None = None,
    first: Callable[[PlenopticCamera, Images], None] = lambda camera, images: None,
) -> Experiment:
    """Return captures and reconstructions of an experiment; finished stages come from the store.

    `first` is called with what was refocused so far: by rays, before all that takes longer, then by waves.
    """
    if against is not None:
        require_choice("against", against, Against)
    refuse_if(
        not any(kind in settings.variant for kind in ("mono", "rgb")),
        f"variant = {settings.variant!r}: a comparison is made in one colour or in three; use a mono or an rgb variant",
    )
    scene = settings.load()
    sensor = scene.sensors()[0]
    camera = PlenopticCamera.from_sensor(sensor)
    camera.require_array("compare")
    colours = "luminance" if mi.is_monochromatic else "rgb"
    refuse_if(
        mi.is_rgb and sensor.film().base_channels_count() == 1,
        f"variant = {settings.variant!r}: the film of {settings.scene} records one colour; use a mono variant",
    )
    refuse_if(
        camera.is_cropped, f"{settings.scene}: a comparison needs the full detector; remove the film's crop window"
    )
    distances = sorted({*settings.distances, *settings.slider})
    require_distances(distances, camera)
    twin = None
    if against is not None:
        distance = settings.distances[0]
        with naming(f"against = {ORDINARY}"):
            refuse_if(math.isinf(distance), "distance = inf: sharpness is measured on an edge at a finite distance")
            # First without the array, which says of some main lenses that they need one.
            twin = camera.replace(mla_lattice="none").replace(focus_distance=distance)
    require_support(camera, Use.RAY_REFOCUSING | Use.SCENES)
    if not is_supported(camera, Use.FIELDS):
        possible = tuple(
            method for method in settings.methods if method.options["method"] not in ("coherent", "partial")
        )
        if possible != settings.methods:
            _log.info("coherent, partial: they are left out, as no wave goes back behind %s", camera.lens_data.label)
        settings = replace(settings, methods=possible)

    # Rays first, then waves, whose first results are shown before all that takes longer.
    methods = sorted(settings.methods, key=lambda method: ("ray_of_ray", "partial", method.name).index(method.name))
    # Lens by lens, a plane near focus takes much less by itself than with others.
    alone = [[distance] for distance in settings.distances]
    groups = {
        method.name: [distances] if method.name in settings.slider_methods else alone for method in settings.methods
    }
    pixels = math.prod(camera.resolution)
    lights = [settings.wavelength] if mi.is_monochromatic else RGB_WAVELENGTHS
    work = [("captures", 0.3 + 6e-8 * len(lights) * pixels * settings.spp)]
    for method in methods:
        name = method.name.partition("_")[0]
        for together in groups[method.name]:
            seconds = 0.1 + 1e-6 * _PRICES[name] * pixels * len(together) * len(lights)
            # A ray capture is deconvolved by rays.
            if name in _STEPS and method.name != "deconvolved_of_ray":
                price = hook("price of a response", name)
                seconds = sum(price(camera, at, light, _STEPS[name]) for at in together for light in lights)
            if method.name == "partial":
                # The white image by waves, which the first method computes.
                seconds += len(lights) * (2.0 + 1e-6 * pixels)
            work += [(name, seconds), *[(name, 0.0)] * (len(together) - 1)]
    work.insert(1 + len(alone), ("captures", len(lights) * (1.5 + 2.5e-7 * pixels * settings.spp)))
    others = 6 * (twin is not None) + (settings.points is not None) + 1 + len(distances)
    work += [("photographs", 1.0)] * others
    store.expected = [seconds for _, seconds in work]
    prices = {name: sum(seconds for other, seconds in work if other == name) for name in dict(work)}
    prices["all"] = sum(store.expected)
    _log.info(
        "roughly, on two cores: %s", ", ".join(f"{name} {in_words(round(value, 1))}" for name, value in prices.items())
    )

    by_rays = settings.by("ray")
    by_waves = settings.by("wave")
    if mi.is_rgb:
        by_waves = replace(by_waves, wavelength=None)
    ray, ray_key = captured(store, "capture_ray", by_rays, scene, noise=settings.noise)
    refuse_if(not ray.image.any(), f"{settings.scene}: the capture is black: its camera sees no light")
    images: Images = {}
    sources = {"ray": (ray, ray_key)}

    # Spreads behind an objective are known by waves alone.
    by_rays_alone = ("ray", "deconvolved") if camera.objective is None else ("ray",)

    def refocus(*names: str) -> None:
        for method in (method for method in methods if method.name in names):
            options = method.options
            if method.source == "ray" and options["method"] not in by_rays_alone:
                options = options | {"wavelength": wave.wavelength}
                if options["method"] == "deconvolved":
                    options["response"] = "wave"
            for together in groups[method.name]:
                results = refocused(store, method.name, *sources[method.source], together, options)
                images.update({(method.name, distance): image for distance, image in results.items()})

    refocus("ray_of_ray")
    first(camera, images)
    wave, wave_key = captured(store, "capture_wave", by_waves, scene, noise=settings.noise)
    sources["wave"] = wave, wave_key
    refocus("partial")
    first(camera, images)
    refocus(*(method.name for method in settings.methods if method.name not in ("ray_of_ray", "partial")))
    points = None
    if settings.points is not None:
        of_points = replace(by_waves, spp=settings.points)
        points, _ = captured(store, "capture_points", of_points, scene, method="points")
    ordinary = None
    if twin is not None:
        ordinary = against_ordinary(store, by_waves, scene, camera, twin, settings.distances[0])
    # Details much finer than the lenses are in no capture, and paths through a room of walls take long.
    columns = min(OBJECT_COLUMNS, max(256, 8 * camera.bin_count[0]))
    scene_key = replace(by_rays, spp=None).fingerprint()

    def pictured(name: str, make: Callable[..., Array], *options: Any, **facts: float) -> Array:
        picture = partial(make, scene, camera, *options, pixel_format=colours)
        inputs = {"scene": scene_key, "options": options}
        return store.image(name, inputs, lambda _: (picture(), {"kind": "photograph", **facts}))[0]

    pinhole = pictured("object", pinhole_image, columns, 64)
    truths = {}
    for distance in distances:
        # The slider's pictures have no numbers.
        spp = settings.truth_spp if distance in settings.distances else max(1, settings.truth_spp // 4)
        name = f"thin_lens_{distance:g}"
        truths[distance] = pictured(name, thin_lens_image, distance, spp, distance=distance)
    return Experiment(
        settings=settings,
        camera=camera,
        ray=ray,
        wave=wave,
        points=points,
        wave_key=wave_key,
        truths=truths,
        images=images,
        pinhole=pinhole,
        boxes=bounding_boxes(scene),
        seconds=store.seconds,
        ordinary=ordinary,
    )


def captured(
    store: Cache, name: str, spec: CaptureSpec, scene: mi.Scene, identity: Any = None, **options: Any
) -> tuple[Capture, str]:
    """Return a capture of a loaded scene as a stage, and the stage's key.

    `identity` is that of a scene other than the specification's, and `options` are further ones of `render_capture`.
    """

    def make(progress: Progress, checkpoint: Checkpoint) -> Capture:
        resumed = {"checkpoint": checkpoint} if spec.model == "wave" else {}
        capture = spec.render(scene, progress=progress, **resumed, **options)
        # The film of a mono variant has three equal channels.
        grey = capture.image.ndim == 3 and mi.is_monochromatic
        return _changed(capture, lambda image: image[..., 1]) if grey else capture

    return store.capture(name, {"capture": spec.fingerprint(), "seen": identity, **options}, make)


def against_ordinary(
    store: Cache, spec: CaptureSpec, scene: mi.Scene, camera: PlenopticCamera, twin: PlenopticCamera, distance: float
) -> Ordinary:
    """Return what an ordinary camera is compared by: wave captures like the plenoptic one, as stages."""
    capture, _ = captured(store, "capture_ordinary", spec, with_camera(scene, twin), twin.to_dict())
    lenses = round(32 * camera.micro_image_pitch / camera.pixel_size)
    recorded = {}
    # The edge's diffraction reaches many pixels of an ordinary camera to the sides.
    for name, full_camera, count in ((ORDINARY, twin, (512, 128)), ("plenoptic", camera, (lenses, lenses))):
        middle = full_camera.replace(resolution=count, detector_width=count[0] * full_camera.pixel_size)
        edge_key = {"camera": middle.to_dict(), "edge": distance}
        recorded[name] = captured(store, f"edge_{name}", spec, edge_scene(middle, distance), edge_key)
    edges = {ORDINARY: recorded[ORDINARY][0].image}
    for method in COMPARED_METHODS:
        if method.name in SLIDER_METHODS:
            images = refocused(store, f"edge_{method.name}", *recorded["plenoptic"], [distance], method.options)
            edges[method.name] = images[distance]
    return Ordinary(capture, distance, edges)


def edge_scene(camera: PlenopticCamera, distance: float) -> mi.Scene:
    """Return a camera before a half plane of radiance 1 whose slanted edge crosses the axis."""
    T = mi.ScalarTransform4f()
    half = 4 * camera.detector_width * distance / camera.mla_distance
    turned = T.translate([0, 0, distance]) @ T.rotate([0, 0, 1], math.degrees(EDGE_TILT)) @ T.translate([half, 0, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "camera": camera.to_sensor(),
            "edge": {
                "type": "rectangle",
                "to_world": turned @ T.rotate([0, 1, 0], 180) @ T.scale(half),
                "bsdf": {"type": "diffuse", "reflectance": 0.0},
                "emitter": {"type": "area", "radiance": 1.0},
            },
        },
        parallel=False,
    )


def open_store(output: Path, stages: StageOptions | None) -> Cache:
    """Return the store in an output folder, checked before the work and created with the first stage."""
    there = next(path for path in (output, *output.absolute().parents) if path.exists())
    refuse_if(
        not there.is_dir() or not os.access(there, os.W_OK),
        f"{output}: the folder cannot be made: {there} is not a folder that can be written to",
    )
    return Cache(output / "data", stages)


def refocused(
    store: Cache, name: str, capture: Capture, key: str, distances: Sequence[float], options: Facts
) -> dict[float, Array]:
    """Return reconstructions by distance of a capture, identified by a key, by options of `reconstruct`, as stages.

    The first that is missing makes all, which share the propagation to the main lens.
    """
    results: dict[float, Reconstruction] = {}

    def make(distance: float, progress: Progress) -> tuple[Array, Named]:
        if not results:
            together = reconstruct(capture, list(distances), progress=progress, **options)
            results.update({result.distance: result for result in together})
        result = results[distance]
        return result.image, header_of(result, capture.metadata)

    images = {}
    for distance in distances:
        inputs = {"capture": key, "distance": distance, "together": list(distances), **options}
        images[distance], _ = store.image(f"{name}_{distance:.12g}", inputs, partial(make, distance))
    return images


def _changed(capture: Capture, change: Callable[[Array], Array], **facts: Any) -> Capture:
    """Return a capture whose image and noise, and some facts, are changed."""
    noise = None if capture.noise is None else change(capture.noise)
    return replace(capture, image=change(capture.image), noise=noise, **facts)


def bounding_boxes(scene: Any) -> dict[str, Pair]:
    """Return the bounding boxes of the shapes, by id, in the camera's frame."""
    to_camera = np.linalg.inv(scene.sensors()[0].world_transform().matrix.numpy()[..., 0].astype(np.float64))
    boxes = {}
    # Sorted, because Mitsuba loads shapes in parallel and lists them as they come.
    for shape in sorted(scene.shapes(), key=lambda shape: shape.id()):
        corners = np.array([[*np.array(shape.bbox().corner(i)).ravel(), 1.0] for i in range(8)])
        inside = (corners @ to_camera.T)[:, :3]
        boxes[shape.id()] = (inside.min(axis=0), inside.max(axis=0))
    return boxes
