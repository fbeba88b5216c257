"""Pictures of a scene by the camera's main lens without the array: thin, a pinhole, or an objective."""

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..errors import LONGEST
from ..lenses import FourierLens, TelecentricLens
from ..runtime import Array, Pair, Shape, Triple
from ..scene import SceneLight, pass_counts, random_numbers


def thin_lens_image(
    scene: Any, camera: PlenopticCamera, distance: float, spp: int, oversample: int = 1, pixel_format: str = "luminance"
) -> Array:
    """Return the image of a thin lens with the camera's aperture, focused at `distance`, one pixel per bin.

    Reconstructions of the same distance have the same bins, and can be compared with the image bin by bin. Of cameras
    with an objective the image is `objective_image`.

    Parameters
    ----------
    scene : mitsuba.Scene
        The scene.
    camera : PlenopticCamera
        The camera; a main lens other than an objective is taken as ideal.
    distance : float
        Distance of the plane in focus, in millimetres.
    spp : int
        Samples per pixel.
    oversample : int
        Bins per lens along each axis.
    pixel_format : {"luminance", "rgb"}
        What the film records.
    """
    columns, rows = (bins * oversample for bins in camera.bin_count)
    if camera.objective:
        return objective_image(scene, camera, distance, spp, (columns, rows), camera.bin_size(distance) / oversample)
    # Samples spread evenly over pixel and aperture leave a fraction of the noise of independent ones.
    spread = {"sampler": {"type": "multijitter"}} if math.isqrt(spp) ** 2 == spp else {}
    sensor = photographic_sensor(
        scene,
        camera,
        (columns, rows),
        pixel_format,
        type="thinlens",
        aperture_radius=camera.aperture_radius,
        focus_distance=min(distance, LONGEST),
        **spread,
    )
    return photograph(scene, sensor, spp)


def pinhole_image(
    scene: Any, camera: PlenopticCamera, columns: int, spp: int, pixel_format: str = "luminance"
) -> Array:
    """Return the sharp image of the camera's field from the centre of its main lens or stop, `columns` pixels wide."""
    across, down = camera.bin_count
    rows = round(columns * down / across)
    if camera.objective:
        pixel = camera.bin_size(0.0) * across / columns
        return objective_image(scene, camera, 0.0, spp, (columns, rows), pixel, aperture=0.0)
    sensor = photographic_sensor(scene, camera, (columns, rows), pixel_format, type="perspective")
    return photograph(scene, sensor, spp)


def photographic_sensor(
    scene: Any, camera: PlenopticCamera, size: Shape, pixel_format: str = "luminance", **lens: Any
) -> Any:
    """Return a Mitsuba sensor with the camera's field, at the position of the scene's first sensor."""
    width = camera.bin_count[0] * camera.row_pitch
    return mi.load_dict(
        {
            "to_world": mi.ScalarTransform4f(scene.sensors()[0].world_transform().matrix.numpy()[..., 0]),
            # Mitsuba's own cameras see up to 10,000 units by default.
            "far_clip": 1e12,
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


def photograph(scene: Any, sensor: Any, spp: int) -> Array:
    """Return a picture by rays (rows, columns[, 3]), rendered in passes of bounded size."""
    columns, rows = sensor.film().crop_size()
    integrator = scene.integrator()
    # A wave integrator's child sees the scene by rays.
    integrator = getattr(integrator, "child", integrator)
    total = np.zeros((rows, columns, sensor.film().base_channels_count()))
    counts = pass_counts(sensor, spp, max(1, 2**24 // (columns * rows)))
    for index, count in enumerate(counts):
        image = mi.render(scene, sensor=sensor, integrator=integrator, spp=count, seed=index)
        total += count / sum(counts) * np.array(image, dtype=np.float64)
    return total[..., 0] if total.shape[2] == 1 else total


def objective_image(
    scene: Any,
    camera: PlenopticCamera,
    distance: float,
    spp: int,
    size: Shape,
    pixel: float,
    aperture: float = 1.0,
) -> Array:
    """Return the picture that the camera's objective takes without the array, focused at a depth, (rows, columns[, 3]).

    Radiance is averaged over a pixel and over the light that passes the stop and the field stop; NaN where less than
    half passes. In rgb variants the picture has colours.

    Parameters
    ----------
    scene : mitsuba.Scene
        The scene.
    camera : PlenopticCamera
        The camera, with an objective.
    distance : float
        Depth of the plane in focus, in millimetres.
    spp : int
        Samples per pixel.
    size : (int, int)
        Columns and rows.
    pixel : float
        Width of a pixel in the object in millimetres.
    aperture : float
        Fraction of the stop's radius that is open.
    """
    columns, rows = size
    integrator = scene.integrator()
    # A wave integrator's child sees the scene by rays, and light that is traced from emitters finds no such camera.
    integrator = getattr(integrator, "child", integrator)
    if not isinstance(integrator, mi.SamplingIntegrator):
        integrator = mi.load_dict({"type": "path"})
    light = SceneLight(scene, scene.sensors()[0], integrator, 550.0 if mi.is_spectral else None)
    total = np.zeros((3 if mi.is_rgb else 1, rows, columns))
    passed = np.zeros((rows, columns))
    # Samples of a pixel side by side, in passes of bounded size.
    together = max(1, 2**22 // passed.size)
    # Samples in cells of the stop leave a fraction of the noise of independent ones.
    cells = root if (root := math.isqrt(spp)) ** 2 == spp else 1
    for done in range(0, spp, together):
        count = min(together, spp - done)
        middle = dr.repeat(dr.arange(mi.UInt32, passed.size), count)
        row, cell = middle // columns, done + dr.tile(dr.arange(mi.UInt32, count), passed.size)
        random = random_numbers(done, dr.width(middle))
        jitter = random.next_2d()
        inside = (mi.Point2f(cell % cells, cell // cells % cells) + random.next_2d()) / cells
        x = (0.5 * columns - mi.Float(middle - row * columns) - jitter.x) * pixel
        y = (0.5 * rows - mi.Float(row) - jitter.y) * pixel
        stop = mi.warp.square_to_uniform_disk_concentric(inside) * (aperture * camera.aperture_radius)
        point, slope, is_open = telecentric_rays(camera, (x, y, distance), (stop.x, stop.y))
        values = light(point, slope, is_open, spp + done)
        total += np.array(values, dtype=np.float64).reshape(*total.shape, count).sum(axis=-1)
        passed += np.array(is_open).reshape(rows, columns, count).sum(axis=-1)
    image = np.where(2 * passed >= spp, total, np.nan) / np.maximum(passed, 1)
    return np.moveaxis(image, 0, -1) if mi.is_rgb else image[0]


def telecentric_rays(camera: PlenopticCamera, point: Triple, stop: Pair) -> Triple:
    """Return rays from points of the stop through object points, and whether the field stop lets them pass.

    A ray is a point on the objective's front principal plane and a slope.
    """
    lens: Any = camera.objective
    start, slope, _ = TelecentricLens(lens).ray(stop, (0.0, 0.0))
    x, y = (at - point[2] * steep for at, steep in zip(point, slope, strict=False))
    is_open = FourierLens(lens).field_inset(-lens.magnification * x, -lens.magnification * y) >= 0
    return (start[0] + x, start[1] + y, start[2]), slope, is_open
