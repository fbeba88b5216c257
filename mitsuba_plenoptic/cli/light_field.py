"""Commands on light fields: ``views``, ``epi``, ``stack``, ``depth``, and ``convert`` to other formats."""

import math
from pathlib import Path
from typing import Annotated, Literal

import typer

from ..choices import ANIMATED, LIGHT_FIELDS, PICTURES, Axis
from ..errors import naming, refuse_if, require_suffix, warn
from ..runtime import progress_bar
from . import options
from .inputs import drawing_of, light_field, named_camera, require_in_sight


def views(
    source: options.CaptureFile,
    *,
    output: Annotated[Path, options.ends_in(*PICTURES, *ANIMATED)],
    count: int | None = None,
    truth: options.Existing | None = None,
    light: options.LightField,
    picture: options.Picture,
) -> None:
    """Show the scene from many positions on the main lens.

    Each view is an image with one pixel per microlens, as a camera with a small aperture at that position would take
    it. The mosaic arranges the views as they lie on the pupil, seen from behind the camera, the upper left first.

    Parameters
    ----------
    output : FILE
        File to write: OpenEXR with a part for each view if it ends in .exr, a mosaic if in .png, a labelled grid if
        in .pdf, a tour round the pupil if in .gif.
    count
        Write N x N views, evenly spread over the pupil. Default: all.

    Examples
    --------
    $ mitsuba-plenoptic views raw.exr -o views.png --count 5
    $ mitsuba-plenoptic views raw.exr -o centre.png --count 1
    $ mitsuba-plenoptic views raw.exr -o orbit.gif
    """
    from ..report import write_orbit, write_views
    from ..runtime import require_output
    from ..views import pick_views

    require_output(output, source, light["white"], truth)
    drawing = drawing_of(picture, output)
    lf = light_field(source, light, named_camera(light["camera"]), truth or True)
    if count is not None:
        lf = pick_views(lf, count)
    if output.suffix.lower() in ANIMATED:
        frames = write_orbit(output, lf, drawing)
        typer.echo(f"{output}: {frames} views of {lf.sizes['s']} x {lf.sizes['t']} pixels, one after the other")
        return
    write_views(output, lf, drawing)
    typer.echo(f"{output}: {lf.sizes['u']} x {lf.sizes['v']} views of {lf.sizes['s']} x {lf.sizes['t']} pixels")


def epi(
    source: options.CaptureFile,
    *,
    output: Annotated[Path, options.ends_in(*PICTURES)],
    axis: Axis = "horizontal",
    at: float | None = None,
    through: float | None = None,
    light: options.LightField,
    picture: options.Picture,
) -> None:
    """Show one line of the scene from every view along the same direction.

    A point of the scene draws a line: upright in focus, slanted by its depth.

    Parameters
    ----------
    output : FILE
        File to write: .exr, .png, or .pdf with axes.
    axis
        Direction of the line.
    at : MM
        Position of the line in the object plane in focus: y (up) of a horizontal, x (left) of a vertical one.
        Default: nearest to the axis.
    through : MM
        Position on the pupil: y (up) of a horizontal, x (left) of a vertical line. Default: nearest to the middle.

    Examples
    --------
    $ mitsuba-plenoptic epi raw.exr -o epi.png --at 2.5
    """
    from ..report import write_epipolar_image
    from ..runtime import require_output
    from ..views import epipolar_image

    require_output(output, source, light["white"])
    drawing = drawing_of(picture, output)
    lf = light_field(source, light, named_camera(light["camera"]))
    image = epipolar_image(lf, axis, at=at, through=through)
    write_epipolar_image(output, image, drawing)
    rows, columns = image.shape[:2]
    typer.echo(f"{output}: {rows} views of {columns} pixels")


def stack(
    source: options.CaptureFile,
    *,
    output: Annotated[Path, options.ends_in(*PICTURES, *ANIMATED)],
    distance: options.Distances | None = None,
    disparity: list[options.Number] | None = None,
    light: options.LightField,
    picture: options.Picture,
) -> None:
    """Make a focal stack: one image for each distance, in focus there.

    The capture is decoded into views, which are moved against each other and added. All images have the same size, one
    pixel per microlens. 'reconstruct' refocuses the capture itself, by rays and by waves.

    Parameters
    ----------
    output : FILE
        File to write: OpenEXR with a part for each distance if it ends in .exr, pictures side by side if in .png, a
        labelled figure if in .pdf, a focal sweep between the distances if in .gif.
    disparity : PIXELS
        Instead: pixels that points in focus move from view to view, negative nearer; no camera needed.

    Examples
    --------
    $ mitsuba-plenoptic stack raw.exr -o stack.exr --distance 210 --distance 240 --distance 280
    $ mitsuba-plenoptic stack raw.exr -o sweep.gif --distance 200 --distance 300
    $ mitsuba-plenoptic stack field.mat -o stack.png --disparity -0.5 --disparity 0.5
    """
    if not distance and not disparity:
        raise typer.BadParameter("give at least one, or a disparity", param_hint="--distance")
    refuse_if(distance and disparity, "--distance, --disparity: give one of the two")
    camera_of_option = require_in_sight(source, named_camera(light["camera"]), *(distance or []))
    by, planes = ("distance", distance) if distance else ("disparity", disparity or [])

    # Brings libraries that take a while to load.
    from ..report import sweep_distances, write_focal_sweep, write_stack
    from ..runtime import require_output
    from ..views import focal_stack

    require_output(output, source, light["white"])
    drawing = drawing_of(picture, output)
    lf = light_field(source, light, camera_of_option)
    animated = output.suffix.lower() in ANIMATED
    with progress_bar("Refocusing") as progress:
        images = focal_stack(lf, sweep_distances(planes, by) if animated else planes, by=by, progress=progress)
    if animated:
        frames = write_focal_sweep(output, images, drawing)
        typer.echo(f"{output}: {frames} images from {planes[0]:g} to {planes[-1]:g} {images[by].units} and back")
        return
    write_stack(output, images, drawing)
    rows, columns = images.shape[1:3]
    typer.echo(f"{output}: {len(images)} images of {columns} x {rows} bins")


_LITTLE = 0.1
"""Fraction of the bins with a confidence above half, below which a user is warned."""


def depth(
    source: options.CaptureFile,
    *,
    output: Annotated[Path, options.ends_in(*PICTURES)],
    near: float | None = None,
    far: float | None = None,
    planes: int | None = None,
    truth: options.Existing | None = None,
    light: options.LightField,
    picture: options.Picture,
) -> None:
    """Estimate depth, and an image in focus everywhere, from how views agree.

    Depth is measured from the main lens along the axis. The confidence estimates the probability that a depth is within
    1 %; below 0.5 the depth is unknown. It is 0 where the views agree best at an end of the search range. With a known
    ground truth, the error of the depth is printed. Light fields of other programs without a camera give disparities:
    pixels that a point moves along the index from view to view, negative nearer than the plane in focus.

    Parameters
    ----------
    output : FILE
        File to write: OpenEXR with the parts depth, disparity, confidence and image if it ends in .exr; if in .png
        pictures of the all-in-focus image, the depth (near is white) and the confidence; if in .pdf these with their
        scales.
    near : MM
        Nearest distance to search, or least disparity. Default: as the file states, or as near as depth shows.
    far : MM
        Farthest distance to search, or greatest disparity. Default: as the file states, or as far as depth shows.
    planes
        Number of distances to try. Default: 64, more for a wide search.

    Examples
    --------
    $ mitsuba-plenoptic depth raw.exr -o depth.exr --near 195 --far 310
    """
    from ..report import write_depth
    from ..runtime import require_output
    from ..views import beyond_search, depth_error, depth_map, is_focused, open_micro_images

    require_output(output, source, light["white"], truth)
    drawing = drawing_of(picture, output)
    camera_of_option = named_camera(light["camera"])
    lf = light_field(source, light, camera_of_option, truth or True)
    images = None
    if is_focused(lf):
        images = open_micro_images(source, white=light["white"], linear=light["linear"], camera=camera_of_option)
    with progress_bar("Comparing views") as progress:
        estimate = depth_map(lf, near, far, micro_images=images, planes=planes, progress=progress)
    write_depth(output, estimate, drawing)
    sure = estimate.confidence > 0.5
    unit = "mm" if "depth" in estimate else "pixels per view"
    where = (estimate.depth if "depth" in estimate else estimate.disparity).where(sure)
    fraction = f"{100 * float(sure.mean()):.0f} % of the bins with a confidence above half"
    ends = dict(zip(("near", "far"), beyond_search(estimate), strict=True))
    if float(sure.mean()) < _LITTLE:
        warn(
            f"depth: hardly any bin determines it from {estimate.attrs['near']:.4g} to {estimate.attrs['far']:.4g} "
            f"{unit}: the scene has too little texture, or is nearer or farther: widen the search with --near and "
            "--far; look at the confidence before you use a depth"
        )
        ends.clear()
    for end, beyond in ends.items():
        if beyond >= _LITTLE and math.isfinite(estimate.attrs[end]):
            warn(
                f"depth: {100 * beyond:.0f} % of the bins agree best at the {end} end of the search, "
                f"{estimate.attrs[end]:.4g} {unit}, and are probably {'nearer' if end == 'near' else 'farther'}: widen "
                f"the search with --{end}"
            )
    span = f", from {float(where.min()):.4g} to {float(where.max()):.4g} {unit}" if bool(sure.any()) else ""
    typer.echo(f"{output}: {fraction}{span}")
    if "depth" not in estimate:
        typer.echo(
            "no camera: these are disparities, negative nearer than the plane in focus, positive farther (HCI's have "
            "the other sign)"
        )
    if "truth" in estimate and (error := depth_error(estimate)).share:
        typer.echo(
            f"error there against ground truth: median {error.median:.2%} of the distance, 90th percentile "
            f"{error.percentile_90:.2%}"
        )


def convert(
    source: options.CaptureFile,
    *,
    output: Annotated[Path, options.ends_in()],
    format: Literal["hci"] | None = None,
    truth: options.Existing | None = None,
    light: options.LightField,
) -> None:
    """Decode a capture into a light field, or change a light field's format.

    NetCDF and Zarr keep the whole light field, with axes, weights and camera, for xarray and for the other commands.

    Parameters
    ----------
    output : FILE
        File to write: .nc or .zarr for NetCDF or Zarr, .mat for LFToolbox, .eslf.png for the samples of each lens
        together, .png for a 16-bit mosaic of views. With --format hci a folder.
    format
        Write a folder as those of the 4D Light Field Benchmark (HCI): a picture for each view, the geometry, and
        depth where ground truth is known. Default: by the output's name.

    Examples
    --------
    $ mitsuba-plenoptic convert raw.exr -o lf.nc
    $ mitsuba-plenoptic convert photo.png --white white.png -o lf.mat
    $ mitsuba-plenoptic convert raw.exr -o folder --format hci
    $ mitsuba-plenoptic convert folder -o lf.nc
    """
    if format is None:
        require_suffix(output, LIGHT_FIELDS)
    from ..extension import format_of, place
    from ..runtime import require_output
    from ..views import HCI, save_light_field

    writer = None
    if format is not None:
        writer = format_of(HCI, "light field", f"format = {format}", write=True)
        refuse_if(output.exists() and not output.is_dir(), f"{output}: it is a file; name a folder")
    require_output(output, source, light["white"], truth, is_folder=format is not None)
    lf = light_field(source, light, named_camera(light["camera"]), truth or True)
    if writer is not None:
        depth_of_views = lf.coords.get("virtual_depth", lf.coords.get("depth"))
        central = None if depth_of_views is None else depth_of_views.values[lf.sizes["v"] // 2, lf.sizes["u"] // 2]
        with naming(source):
            views = place(*writer)(output, lf, central, name=source.stem)
        typer.echo(f"{output}: {views} x {views} views of {lf.sizes['s']} x {lf.sizes['t']} pixels")
        return
    save_light_field(output, lf)
    typer.echo(f"{output}: {lf.sizes['u']} x {lf.sizes['v']} views of {lf.sizes['s']} x {lf.sizes['t']} pixels")
