"""The experiment behind every report: one scene captured by rays and by waves, and refocused by every method."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..choices import Against
from ..errors import naming, refuse_if, require_choice
from ..io.captures import Capture
from ..light.render_capture import pass_counts, plenoptic_sensor, quiet, render_capture
from ..light.scene import load_scene
from ..plugins.other_camera import with_camera
from ..refocus import Reconstruction, reconstruct
from ..refocus.methods import require_distances
from ..runtime.backend import DEFAULT_VARIANT, set_variant
from .stage_store import Progress, StageOptions, Stages, scene_fingerprint

_RAYS_PER_PASS = 2**24


def thin_lens_image(scene: Any, camera: PlenopticCamera, distance: float, spp: int, oversample: int = 1) -> np.ndarray:
    """Return the image of a thin lens with the camera's aperture, focused at `distance`, one pixel per bin.

    Reconstructions of the same distance have the same bins, and can be compared with the image bin by bin.

    Parameters
    ----------
    scene : mitsuba.Scene
        The scene, in a variant of one colour.
    camera : PlenopticCamera
        The camera; its main lens is taken as ideal.
    distance : float
        Distance of the plane in focus, in millimetres.
    spp : int
        Samples per pixel.
    oversample : int
        Bins per lens along each axis.
    """
    columns, rows = camera.bin_count
    # Samples spread evenly over pixel and aperture leave a fraction of the noise of independent ones.
    spread: dict[str, Any] = {"sampler": {"type": "multijitter"}} if math.isqrt(spp) ** 2 == spp else {}
    lens: dict[str, Any] = {"type": "thinlens", "aperture_radius": camera.aperture_radius, "focus_distance": distance}
    size = (columns * oversample, rows * oversample)
    sensor = photographic_sensor(scene, camera, size, "luminance", **lens, **spread)
    return photograph(scene, sensor, spp)


def pinhole_image(scene: Any, camera: PlenopticCamera, columns: int, spp: int) -> np.ndarray:
    """Return the sharp image of the camera's field from the centre of its main lens, `columns` pixels wide."""
    rows = round(columns * camera.bin_count[1] / camera.bin_count[0])
    return photograph(scene, photographic_sensor(scene, camera, (columns, rows), type="perspective"), spp)


_FARTHEST = 1e12
"""Distance up to which the truth is seen, in units of the scene."""


def photographic_sensor(
    scene: Any, camera: PlenopticCamera, size: tuple[int, int], pixel_format: str = "luminance", **lens: Any
) -> Any:
    """Return a Mitsuba sensor with the camera's field, at the position of the scene's first sensor."""
    width = camera.bin_count[0] * camera.mla_pitch
    return mi.load_dict(
        {
            "to_world": mi.ScalarTransform4f(scene.sensors()[0].world_transform().matrix.numpy()[..., 0]),
            # Mitsuba's own cameras see up to 10,000 units by default.
            "far_clip": _FARTHEST,
            **lens,
            "fov": math.degrees(2 * math.atan(width / (2 * camera.mla_distance))),
            "film": {
                "type": "hdrfilm",
                "width": size[0],
                "height": size[1],
                "rfilter": {"type": "box"},
                "pixel_format": pixel_format,
                "component_format": "float32",
            },
        }
    )


def photograph(scene: Any, sensor: Any, spp: int) -> np.ndarray:
    """Return a picture by rays (rows, columns[, 3]), rendered in passes of bounded size."""
    columns, rows = sensor.film().crop_size()
    integrator = scene.integrator()
    # A wave integrator's child sees the scene by rays.
    integrator = getattr(integrator, "child", integrator)
    total = np.zeros((rows, columns, sensor.film().base_channels_count()))
    counts = pass_counts(sensor, spp, max(1, _RAYS_PER_PASS // (columns * rows)))
    for index, count in enumerate(counts):
        part = mi.render(scene, sensor=sensor, integrator=integrator, spp=count, seed=index)
        total += count / sum(counts) * np.array(part, dtype=np.float64)
    return total[..., 0] if total.shape[2] == 1 else total


OBJECT_COLUMNS = 1024
_FEWEST_COLUMNS = 256


class RefocusMethod(NamedTuple):
    """A refocusing method: name, title in figures, options of `reconstruct`, and the capture that it refocuses."""

    name: str
    title: str
    options: dict[str, Any]
    source: str = "wave"


METHODS = (
    RefocusMethod("ray_of_ray", "Rays, of the ray capture", {"method": "ray", "footprint": "lens"}, "ray"),
    RefocusMethod("ray_point", "Rays, one bin a pixel", {"method": "ray", "footprint": "point"}),
    RefocusMethod("ray", "Rays, lens footprint", {"method": "ray", "footprint": "lens"}),
    RefocusMethod("coherent", "Coherent", {"method": "coherent"}),
    RefocusMethod("partial", "Partially coherent", {"method": "partial", "interleave": 2}),
    # The limit in which no two lenses interfere.
    RefocusMethod("limit", "One lens at a time", {"method": "partial", "interleave": "auto"}),
)
TITLES = {"truth": "Thin lens (truth)", **{method.name: method.title for method in METHODS}}

# Those that the report's slider shows; the others differ in details only and the last one takes long.
SLIDER_METHODS = ("ray", "coherent", "partial")

ORDINARY = "ordinary"
"""Name of the camera without a microlens array, and of its pictures."""

EDGE_TILT = math.radians(5)
"""Angle of slanted edges, on which sharpness is measured, against the pixels."""

_EDGE_BINS, _EDGE_PIXELS = (32, 32), (512, 128)
"""Bins, or pixels of an ordinary camera, that see an edge; its diffraction reaches many pixels to the sides."""


@dataclass(frozen=True)
class Settings:
    """The settings of an experiment: scene, camera, distances and methods.

    Parameters
    ----------
    scene : str
        A scene file or a built-in name.
    distances : tuple of float
        Distances of the figures and metrics, where all methods are used, in millimetres.
    slider : tuple of float
        Distances of the report's slider, in millimetres.
    parameters : mapping of str to str
        Values for the scene's ``$name`` parameters.
    camera : mapping, optional
        Parameters by name of the camera that replaces the scene's.
    camera_name : str, optional
        What the command calls this camera.
    unit : {"mm", "cm", "m"}
        Unit of the scene's lengths.
    wavelength : float
        Wavelength in nanometres.
    spp : int
        Samples per pixel of both captures.
    points : int, optional
        Points per lens of another wave capture, point by point, with which the one from signed rays is compared.
        Default: no such capture.
    truth_spp : int
        Samples per pixel of the thin lens.
    noise : bool
        Whether the captures keep the noise of their samples, which takes two of each at least.
    variant : str
        A variant of Mitsuba in one colour channel.
    """

    scene: str
    distances: tuple[float, ...]
    slider: tuple[float, ...] = ()
    parameters: Mapping[str, str] = field(default_factory=dict)
    camera: Mapping[str, Any] | None = None
    camera_name: str | None = None
    unit: str = "mm"
    wavelength: float = 633.0
    spp: int = 16
    points: int | None = None
    truth_spp: int = 1024
    noise: bool = False
    variant: str = DEFAULT_VARIANT


@dataclass(frozen=True)
class Ordinary:
    """A scene by the camera without its microlens array, and a slanted edge in focus by both cameras."""

    capture: Capture
    # Distance in focus, of the edge as well.
    distance: float
    # The edge by the ordinary camera, under its name, and by the methods that refocus a capture of it.
    edges: dict[str, np.ndarray]


# Reconstructions by method and distance.
Images = dict[tuple[str, float], np.ndarray]


@dataclass(frozen=True)
class Experiment:
    """Captures and reconstructions of an experiment."""

    settings: Settings
    camera: PlenopticCamera
    ray: Capture
    wave: Capture
    # The wave capture point by point.
    points: Capture | None
    # Where the wave capture lies.
    wave_file: Path
    wave_key: str
    # Thin-lens image by distance.
    truths: dict[float, np.ndarray]
    images: Images
    # The scene from the centre of the main lens.
    pinhole: np.ndarray
    # Bounding boxes of the scene's shapes in the camera's frame by id.
    boxes: dict[str, tuple[np.ndarray, np.ndarray]]
    # How long each stage took.
    seconds: dict[str, float]
    # What the captures are compared with besides each other.
    ordinary: Ordinary | None

    def image(self, method: str, distance: float) -> np.ndarray:
        """Return the reconstruction by a method at a distance, or for ``truth`` the thin lens's image."""
        return self.truths[distance] if method == "truth" else self.images[method, distance]


def run_experiment(
    settings: Settings,
    store: Stages,
    against: str | None = None,
    first: Callable[[PlenopticCamera, Images], None] = lambda camera, images: None,
) -> Experiment:
    """Return captures and reconstructions of an experiment; finished stages come from the store.

    `first` is called with what was refocused so far: by rays, before all that takes longer, then by waves.
    """
    if against is not None:
        require_choice("against", against, Against)
    refuse_if(
        "mono" not in settings.variant,
        f"variant = {settings.variant!r}: a comparison is made in one colour; use a mono variant",
    )
    set_variant(settings.variant)
    scene = load_with_sensor(settings.scene, settings.parameters, settings.camera, settings.unit)
    sensor = scene.sensors()[0]
    camera = PlenopticCamera.from_sensor(sensor)
    camera.require_array("compare")
    refuse_if(
        camera.is_cropped, f"{settings.scene}: a comparison needs the full detector; remove the film's crop window"
    )
    distances = sorted({*settings.distances, *settings.slider})
    require_distances(distances, camera)
    twin = None if against is None else ordinary_twin(camera, settings.distances[0])

    base = {
        "scene": scene_fingerprint(settings.scene, settings.parameters),
        "camera": settings.camera,
        "unit": settings.unit,
        "variant": settings.variant,
    }
    ray, ray_key = store.capture(
        "capture_ray",
        {**base, "spp": settings.spp, "noise": settings.noise},
        lambda progress, _: _grey(
            render_capture(scene, model="ray", spp=settings.spp, noise=settings.noise, progress=progress)
        ),
    )
    refuse_if(not ray.image.any(), f"{settings.scene}: the capture is black: its camera sees no light")
    images: Images = {}
    sources = {"ray": (ray, ray_key)}

    def refocus(methods: Iterable[RefocusMethod]) -> None:
        for method in methods:
            wanted = distances if method.name in SLIDER_METHODS else settings.distances
            for distance in wanted:
                name, source = f"{method.name}_{distance:g}", sources[method.source]
                images[method.name, distance] = refocused(store, name, *source, distance, method.options)

    refocus(method for method in METHODS if method.source == "ray")
    first(camera, images)
    options = {"wavelength": settings.wavelength, "spp": settings.spp, "method": "signed_rays"}
    wave, wave_key = by_waves(store, "capture_wave", scene, base, **options, noise=settings.noise)
    sources["wave"] = wave, wave_key
    refocus(method for method in METHODS if method.name in SLIDER_METHODS)
    first(camera, images)
    refocus(method for method in METHODS if method.source == "wave" and method.name not in SLIDER_METHODS)
    points = None
    if settings.points is not None:
        points, _ = by_waves(
            store, "capture_points", scene, base, **options | {"method": "points", "spp": settings.points}
        )
    ordinary = None
    if twin is not None:
        ordinary = against_ordinary(store, scene, base, camera, twin, settings.distances[0], options)
    # Details much finer than the lenses are in no capture, and paths through a room of walls take long.
    columns = min(OBJECT_COLUMNS, max(_FEWEST_COLUMNS, 8 * camera.bin_count[0]))
    pinhole, _ = store.image(
        "object",
        {**base, "columns": columns},
        lambda _: (pinhole_image(scene, camera, columns, 64), {"kind": "photograph"}),
    )
    truths = {
        distance: store.image(
            f"thin_lens_{distance:g}",
            {**base, "distance": distance, "spp": settings.truth_spp},
            lambda _, distance=distance: (  # type: ignore[misc]
                thin_lens_image(scene, camera, distance, settings.truth_spp),
                {"kind": "photograph", "distance": distance},
            ),
        )[0]
        for distance in distances
    }
    return Experiment(
        settings=settings,
        camera=camera,
        ray=ray,
        wave=wave,
        points=points,
        wave_file=store.folder / "capture_wave.exr",
        wave_key=wave_key,
        truths=truths,
        images=images,
        pinhole=pinhole,
        boxes=bounding_boxes(scene),
        seconds=store.seconds,
        ordinary=ordinary,
    )


def by_waves(
    store: Stages, name: str, scene: mi.Scene, inputs: Mapping[str, object], **options: Any
) -> tuple[Capture, str]:
    """Return a wave capture, by options of `render_capture`, as a stage, and the stage's key."""
    return store.capture(
        name,
        {**inputs, **options},
        lambda progress, checkpoint: _grey(
            render_capture(scene, model="wave", progress=progress, checkpoint=checkpoint, **options)
        ),
    )


def ordinary_twin(camera: PlenopticCamera, distance: float) -> PlenopticCamera:
    """Return the camera without its microlens array, focused at a distance: the same main lens and pixels."""
    with naming(f"against = {ORDINARY}"):
        refuse_if(math.isinf(distance), "distance = inf: sharpness is measured on an edge at a finite distance")
        # First without the array, which says of some main lenses that they need one.
        return camera.replace(mla_lattice="none").replace(focus_distance=distance)


def against_ordinary(
    store: Stages,
    scene: mi.Scene,
    inputs: Mapping[str, object],
    camera: PlenopticCamera,
    twin: PlenopticCamera,
    distance: float,
    options: Mapping[str, Any],
) -> Ordinary:
    """Return what an ordinary camera is compared by: wave captures with the options of the plenoptic one, as stages."""
    facts = {"twin": twin.to_dict()}
    capture, _ = by_waves(store, "capture_ordinary", with_camera(scene, twin), {**inputs, **facts}, **options)
    lenses = tuple(round(count * camera.micro_image_pitch / camera.pixel_size) for count in _EDGE_BINS)
    recorded = {}
    for name, whole, count in ((ORDINARY, twin, _EDGE_PIXELS), ("plenoptic", camera, lenses)):
        middle = whole.replace(resolution=count, detector_width=count[0] * whole.pixel_size)
        seen = {"camera": middle.to_dict(), "edge": distance}
        recorded[name] = by_waves(store, f"edge_{name}", edge_scene(middle, distance), seen, **options)
    edges = {ORDINARY: recorded[ORDINARY][0].image}
    for method in METHODS:
        if method.name in SLIDER_METHODS:
            name = f"edge_{method.name}"
            edges[method.name] = refocused(store, name, *recorded["plenoptic"], distance, method.options)
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


def load_with_sensor(
    name: str, parameters: Mapping[str, str], camera: Mapping[str, Any] | None = None, unit: str = "mm"
) -> Any:
    """Return a scene, with a given camera in place of its sensor; refuse a scene without a plenoptic sensor."""
    # Mitsuba warns that films of colours record luminance, which the variant says.
    with quiet() if mi.is_monochromatic else nullcontext():
        scene = load_scene(name, parameters=parameters, unit=unit)
    if camera is not None:
        return with_camera(scene, PlenopticCamera.from_dict(dict(camera)))
    with naming(name):
        plenoptic_sensor(scene)
    return scene


def open_store(output: Path, stages: StageOptions | None) -> Stages:
    """Return the store in an output folder, checked before the work and created with the first stage."""
    there = next(path for path in (output, *output.absolute().parents) if path.exists())
    refuse_if(
        not there.is_dir() or not os.access(there, os.W_OK),
        f"{output}: the folder cannot be made: {there} is not a folder that can be written to",
    )
    return Stages(output / "data", stages)


def refocused(
    store: Stages, name: str, capture: Capture, key: str, distance: float, options: Mapping[str, Any]
) -> np.ndarray:
    """Return the reconstruction of a capture, identified by a key, by options of `reconstruct`, as a stage."""

    def make(progress: Progress) -> tuple[np.ndarray, dict[str, Any]]:
        result: Reconstruction = reconstruct(capture, distance, progress=progress, **options)
        facts = {"distance": distance, "bin_size": result.bin_size, **options}
        return result.image, {"kind": "reconstruction", "camera": capture.camera.to_dict(), **facts}

    return store.image(name, {"capture": key, "distance": distance, **options}, make)[0]


def _grey(capture: Capture) -> Capture:
    """Return a mono variant's capture, whose film has three equal channels, with one channel."""
    if capture.image.ndim == 2:
        return capture
    noise = None if capture.noise is None else capture.noise[..., 1]
    return replace(capture, image=capture.image[..., 1], noise=noise)


def bounding_boxes(scene: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the bounding boxes of the shapes, by id, in the camera's frame."""
    to_camera = np.linalg.inv(scene.sensors()[0].world_transform().matrix.numpy()[..., 0].astype(np.float64))
    boxes = {}
    # Sorted, because Mitsuba loads shapes in parallel and lists them as they come.
    for shape in sorted(scene.shapes(), key=lambda shape: shape.id()):
        box = shape.bbox()
        corners = np.array([[*np.array(box.corner(i)).ravel(), 1.0] for i in range(8)])
        inside = (corners @ to_camera.T)[:, :3]
        boxes[shape.id()] = (inside.min(axis=0), inside.max(axis=0))
    return boxes
