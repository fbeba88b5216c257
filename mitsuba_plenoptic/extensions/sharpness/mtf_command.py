"""``mitsuba-plenoptic mtf``: the sharpness of a refocused image from a slanted edge in it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ...cli import inputs, options
from ...errors import naming, refuse_if

if TYPE_CHECKING:
    from ...refocus import Reconstruction


def mtf(
    source: options.CaptureFile,
    *,
    distance: float | None = None,
    method: options.Method | None = None,
    oversample: int | None = None,
    region: str | None = None,
    camera: options.CameraFile | None = None,
    linear: bool = False,
) -> None:
    """Measure the modulation transfer function from one slanted edge in a refocused image.

    The edge may lie anywhere, turned by 1 to 20 degrees against the bins. The transfer function is measured across the
    edge, for camera and reconstruction together, in cycles per bin and in line pairs per millimetre of the object. In a
    capture without a microlens array, bins are pixels, and millimetres are those of the plane in focus.

    Parameters
    ----------
    source : CAPTURE
        A capture, which is refocused to --distance, one without microlenses, or what 'reconstruct' wrote.
    distance : MM
        Of a capture: distance to refocus to.
    method
        Of a capture: how it is refocused. Default: ray.
    oversample
        Of a capture: bins per microlens along each axis. Default: 1.
    region : LEFT,TOP,WIDTH,HEIGHT
        Bins to look at, where there are several edges. Default: all.

    Examples
    --------
    $ mitsuba-plenoptic mtf raw.exr --distance 240
    $ mitsuba-plenoptic mtf out.exr --region 20,30,60,40
    $ mitsuba-plenoptic mtf photograph.exr
    """
    named_camera = inputs.named_camera(camera)
    if distance is not None:
        inputs.require_in_sight(source, named_camera, distance)

    # Brings libraries that take a while to load.
    from ...io import read_capture
    from ...refocus import read_reconstruction
    from ...refocus import reconstruct as refocus
    from ...report import edge_sharpness

    of_captures = {"method": method, "oversample": oversample, "camera": camera, "linear": linear or None}
    if distance is None:
        for name, value in of_captures.items():
            refuse_if(value is not None, f"--{name}: it is for captures, with --distance; leave it out")
        image = _photograph(source) or read_reconstruction(source)
    else:
        recorded = read_capture(source, camera=named_camera, linear=linear)
        (image,) = refocus(recorded, [distance], method=method or "ray", oversample=oversample or 1)
    left, top, width, height = _parsed(region, image)
    with naming(source):
        edge = edge_sharpness(image.image[top : top + height, left : left + width])
    where = f"row {edge.row + top:.4g}, column {edge.column + left:.4g}"
    nearer = "columns" if edge.upright else "rows"
    typer.echo(f"edge at {where}, {edge.length} bins long, turned by {edge.angle:.3g} degrees from the {nearer}")
    unit = "rad" if math.isinf(image.distance) else "mm"
    per_bin = 1 / image.bin_size
    typer.echo(f"width, 10 to 90 %: {edge.width:.3g} bins, {edge.width * image.bin_size:.4g} {unit}")
    typer.echo(f"half the contrast at {edge.mtf50:.3g} cycles per bin, {edge.mtf50 * per_bin:.4g} per {unit}")
    for tenth in range(1, 11):
        frequency = tenth / 20
        typer.echo(f"{frequency:.2f} cycles per bin  {frequency * per_bin:9.4g} per {unit}  {edge.at(frequency):.3f}")


def _photograph(source: Path) -> Reconstruction | None:
    """Return a capture without a microlens array as an image of the plane in focus; None for other files."""
    from ...io import read_attributes, read_capture
    from ...refocus import Reconstruction

    if source.suffix.lower() != ".exr" or read_attributes(source).get("kind") != "capture":
        return None
    capture = read_capture(source)
    camera = capture.camera
    focus = capture.camera.focus_distance
    if camera.refocuses:
        return None
    return Reconstruction(capture.image, focus, camera.pixel_in_object(focus), "none", camera)


def _parsed(region: str | None, image: Reconstruction) -> tuple[int, int, int, int]:
    """Return left, top, width and height, in bins, of the region that an option states."""
    rows, columns = image.image.shape[:2]
    if region is None:
        return 0, 0, columns, rows
    parts = region.split(",")
    rule = f"--region {region}: it must be LEFT,TOP,WIDTH,HEIGHT in bins, within {columns} x {rows}"
    refuse_if(len(parts) != 4 or not all(bound.strip().isdecimal() and len(bound) < 8 for bound in parts), rule)
    left, top, width, height = map(int, parts)
    refuse_if(not width or not height or left + width > columns or top + height > rows, rule)
    return left, top, width, height
