"""An HTML page that shows a capture from any viewpoint, refocused and lens by lens, without loading other files."""

from __future__ import annotations

import html
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ...camera import PlenopticCamera
from ...errors import InputError, refuse_if
from ...io import Capture
from ...refocus import Reconstruction
from ...report import images, pages
from ...runtime import Array, Named, write_text
from ...views import (
    bin_grid,
    camera_of,
    decode,
    disparity,
    distance_of,
    grid_of,
    light_field,
    pick_views,
    require_light_field,
    view_mosaic,
    view_steps,
)

# Bytes before compression of all raw pictures, and of the views of all light fields.
_RAW_BYTES = 2**24
_VIEW_BYTES = 2**26

# Brightest value over white from which 8 bits would show bands where the exposure is changed.
_WIDE = 4.0


@dataclass(frozen=True, eq=False)
class Recording:
    """A light field with its title on the page and, if known, the raw picture from which it was decoded."""

    name: str
    light_field: xr.DataArray
    image: Array | None = None
    # Of propagation, where it is known.
    model: str = ""
    # What the page is headed by: the scene and the camera, as far as they are known.
    title: str = ""

    @classmethod
    def of(cls, capture: Capture, name: str, lf: xr.DataArray) -> Recording:
        """Return the recording of a capture with its light field."""
        scene = pages.scene_name(str(capture.metadata.get("scene", "")))
        title = ", ".join(words for words in (scene, _through(capture.camera)) if words)
        return cls(name, lf, capture.image, capture.model, title)


def _through(camera: PlenopticCamera) -> str:
    """Return a camera's description in a few words."""
    columns, rows = camera.lens_count
    lattice = "" if camera.mla_lattice == "square" else f"{camera.mla_lattice} "
    lens = f"f/{camera.f_number:.3g}" if camera.lens_data.converges else camera.lens_data.label
    return f"{lens}, {columns} x {rows} {lattice}microlenses"


def decoded(capture: Capture, white: Capture | Array | None = None) -> xr.DataArray:
    """Return a capture decoded for display.

    For cameras that `decode` does not support, with a real main lens or an objective, a thin lens replaces the exit
    pupil: near the axis it gives the same micro-images. Positions and distances are then left out, as they would be
    those of the thin lens.
    """
    camera = capture.camera
    lens = capture.camera.lens_data
    if lens.is_thin or lens.images_stop:
        return decode(capture, white=white)
    # Distance of a pupil that stands for one infinitely far, in focal lengths.
    further = 1.0 if lens.converges else 1e5
    distance = further * camera.pupil_distance
    radius = further * camera.pupil_radius
    pupil = camera.replace(main_lens=None, focal_length=distance / 2, aperture_radius=radius, mla_distance=distance)
    by = white.image if isinstance(white, Capture) else white
    light_field_of_pupil = decode(replace(capture, camera=pupil), white=by)
    weight, white_samples = (light_field_of_pupil[name].values for name in ("weight", "white"))
    return light_field(light_field_of_pupil.values, weight, lenses=grid_of(light_field_of_pupil), white=white_samples)


@dataclass(frozen=True)
class Viewer:
    """An interactive page made by `view`; notebooks show it in a frame.

    Parameters
    ----------
    page : str
        The page as HTML.
    """

    page: str = field(repr=False)

    def save(self, path: str | Path) -> None:
        """Write the page, which any browser opens from disk.

        Parameters
        ----------
        path : path
            A file whose name ends in ``.html``.
        """
        write_text(path, self.page, ".html")

    def _repr_html_(self) -> str:
        frame = 'width="100%" height="900" style="border: 0" title="Light-field viewer"'
        return f'<iframe {frame} srcdoc="{html.escape(self.page)}"></iframe>'


def view(*sources: Capture | Recording | Reconstruction | xr.DataArray | xr.Dataset, title: str = "") -> Viewer:
    """Make a page that shows captures, light fields and focal stacks interactively.

    The page moves the viewpoint over the pupil, refocuses by shifting and adding the views (the ray model), enlarges
    the micro-images of a capture, and compares two captures. Views and pixels that would make the page too large are
    left out, which the page states.

    Parameters
    ----------
    *sources : Capture, Reconstruction, xarray.DataArray or xarray.Dataset
        One or two captures or light fields of the same bins and views, and what was computed of them: focal stacks and
        reconstructions, which are shown as they are at their distances, and one depth map.
    title : str
        Headline of the page. Default: the scene and the camera, as far as captures state them.

    Returns
    -------
    Viewer
        `Viewer.save` writes the page; notebooks show it.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> mp.view(mp.example("letters-ray"), title="Letters").save("letters.html")
    """
    refuse_if(not sources, "sources: give at least one capture, light field, focal stack, reconstruction or depth map")
    recordings, planes, depths = _sorted(sources)
    refuse_if(len(recordings) > 2, f"sources: {len(recordings)} captures or light fields: a page compares two at most")
    refuse_if(len(depths) > 1, f"sources: {len(depths)} depth maps: a page shows one")
    shapes = [recording.light_field.shape for recording in recordings]
    refuse_if(
        len(set(shapes)) > 1,
        f"sources: light fields of the shapes {' and '.join(map(str, shapes))} cannot be compared: they must be alike",
    )
    for recording in recordings[1:]:
        for axis in recording.light_field.dims[:4]:
            refuse_if(
                not np.allclose(recording.light_field[axis], recordings[0].light_field[axis], rtol=1e-6, atol=1e-9),
                f"sources: light fields whose {axis} differ cannot be compared: they must be of the same camera",
            )
    if depths and recordings:
        refuse_if(
            depths[0]["depth"].shape != shapes[0][2:4],
            f"sources: a depth map of {depths[0]['depth'].shape} bins does not fit a light field of {shapes[0][2:4]}",
        )
    refuse_if(
        len({image.shape for _, image, _ in planes}) > 1, "sources: focal stack: all of its images must be of one size"
    )
    pictures = [recording.light_field.values for recording in recordings] or [image for _, image, _ in planes]
    white = images.Brightness().peak(pictures or [np.asarray(depths[0]["image"])])
    # Alike for both, so that they have the same views.
    wide = any(float(recording.light_field.max()) > _WIDE * white for recording in recordings)
    thinned = [
        _thinned(recording.light_field, _VIEW_BYTES // len(recordings) // (1 + wide)) for recording in recordings
    ]
    names = [recording.name for recording in recordings]
    recorded = [
        _recording(
            recording,
            f"{recording.name} {index}" if names.count(recording.name) > 1 else recording.name,
            lf,
            white,
            16 if wide else 8,
            len(recordings),
        )
        for index, (recording, lf) in enumerate(zip(recordings, thinned, strict=True), 1)
    ]
    full = max([white, *(float(np.nanmax(image, initial=0)) for _, image, _ in planes)])
    bits = 16 if full > _WIDE * white else 8
    data = {
        "white": white,
        "recordings": [content for content, _ in recorded],
        "planes": [
            {"distance": _plain(distance), "method": method, "picture": images.encode(image, bits, full)}
            for distance, image, method in planes
        ],
        "depth": _depth(depths[0]) if depths else None,
    }
    facts = [fact for _, facts in recorded for fact in facts]
    if planes:
        rows, columns = planes[0][1].shape[:2]
        methods = ", ".join(sorted({method for _, _, method in planes}))
        facts.append(("Images of the stack", f"{len(planes)} of {columns} x {rows} bins ({methods})"))
    facts.append(("White", f"the radiance {white:.3g} at an exposure of 0; colours are sRGB"))
    # Scene and camera are mostly those of both.
    headline = (
        title
        or " and ".join(dict.fromkeys(recording.title for recording in recordings if recording.title))
        or "Light field"
    )
    page = pages.template("view.html", Path(__file__).parent / "templates")
    return Viewer(page.render(title=headline[0].upper() + headline[1:], data=data, facts=facts))


def _sorted(sources: tuple) -> tuple[list[Recording], list[tuple[float, Array, str]], list[xr.Dataset]]:
    """Return the light fields, the planes from near to far (distance, image, method), and the depth maps."""
    recordings = []
    planes = []
    depths = []
    for source in sources:
        if isinstance(source, Capture):
            recordings.append(Recording.of(source, source.model, decoded(source)))
        elif isinstance(source, Recording):
            require_light_field(source.light_field)
            recordings.append(source)
        elif isinstance(source, Reconstruction):
            planes.append((source.distance, source.image, source.method))
        elif isinstance(source, xr.DataArray) and source.dims[:1] == ("distance",):
            for image in source:
                planes.append((float(image["distance"]), image.values, source.attrs.get("method", "shifted views")))
        elif isinstance(source, xr.DataArray):
            title = _through(camera_of(source)) if source.attrs.get("camera") else ""
            recordings.append(Recording("light field", require_light_field(source), title=title))
        elif isinstance(source, xr.Dataset) and "depth" in source:
            depths.append(source)
        else:
            raise InputError(
                f"sources: of type {type(source).__name__}: they must be captures, light fields, focal stacks, "
                "reconstructions or depth maps"
            )
    return recordings, sorted(planes, key=lambda plane: plane[0]), depths


def _recording(
    recording: Recording, name: str, lf: xr.DataArray, white: float, bits: int, count: int
) -> tuple[Named, list[tuple[str, str]]]:
    """Return views, raw picture and geometry of a light field for the page, with sentences about them."""
    all_views = recording.light_field
    full = max(float(lf.max()), white)
    left_out = "" if lf is all_views else f" of {all_views.sizes['u']} x {all_views.sizes['v']}, the others left out"
    # Noise has a mean; without what is negative it would be too bright, which is to be stated.
    negative = float((lf.values < 0).mean())
    below = f"; {negative:.2%} of the samples are negative, and 0 in this page" if negative else ""
    size = f"{lf.sizes['s']} x {lf.sizes['t']} bins each; {bits} bits, up to {full:.3g}"
    facts = [(f"Views, {name}", f"{lf.sizes['u']} x {lf.sizes['v']}{left_out}; {size}{below}")]
    # The positions of the views on the pupil, and the disparities and distances of the focus slider.
    try:
        steps = [view_steps(lf, axis).tolist() for axis in "vu"]
        reach = max(1.0, 16.0 / (1 + np.ptp(steps[0])))
        ends = (-reach, reach)
        reason = ""
        if lf.attrs.get("camera"):
            ends = (-reach, min(reach, disparity(lf, math.inf)))
    except InputError as error:
        steps = [[0.0] * lf.sizes[axis] for axis in "vu"]
        ends = (0.0, 0.0)
        reason = str(error)
    disparities = np.linspace(*ends, 161) if ends[1] > ends[0] else np.zeros(1)
    has_distances = bool(lf.attrs.get("camera")) and not reason
    distances = distance_of(lf, disparities) if has_distances else np.full(len(disparities), np.nan)
    content = {
        "name": name,
        "views": images.encode(view_mosaic(lf), bits, full),
        "weight": images.encode(view_mosaic(lf["weight"]), 8, 1.0),
        "raw": None,
        "v": steps[0],
        "u": steps[1],
        "rows": lf.sizes["t"],
        "columns": lf.sizes["s"],
        "disparities": disparities.tolist(),
        "distances": _plain(distances),
        "fixed": reason,
    }
    if recording.image is not None:
        content["raw"], fact = _raw(recording.image, all_views, white, count)
        facts.append((f"Raw picture, {name}", f"{recording.model} model; {fact}" if recording.model else fact))
    return content, facts


def _thinned(lf: xr.DataArray, samples: int) -> xr.DataArray:
    """Return a light field reduced to as many views as a limit of samples allows."""
    count = min(lf.sizes["v"], lf.sizes["u"])
    view_size = lf.sizes["t"] * lf.sizes["s"] * lf.sizes.get("c", 1)
    if count <= 11 and lf.size <= samples:
        return lf
    # Odd numbers of views have a central one.
    count = min(count - 1 + count % 2, 11)
    while count > 3 and count**2 * view_size > samples:
        count -= 2
    return pick_views(lf, count)


def _raw(image: Array, lf: xr.DataArray, white: float, count: int) -> tuple[Named, str]:
    """Return the raw picture with positions of micro-images and bins, and a sentence that describes it."""
    factor = math.ceil(math.sqrt(image.size * count / _RAW_BYTES))
    small = images.shrink(image, math.ceil(max(image.shape[:2]) / factor)) if factor > 1 else image
    full = min(max(float(small.max()), white), _WIDE * white)
    rows, columns = small.shape[:2]
    averaged = f", averaged over {factor} x {factor} pixels" if factor > 1 else ""
    grid = grid_of(lf)
    bins = bin_grid(camera_of(lf)) if lf.attrs.get("camera") and grid else None
    content = {
        "picture": images.encode(small, 8, full),
        "rows": rows,
        "columns": columns,
        "factor": factor,
        "lenses": None
        if grid is None
        else {
            "spacing": grid.spacing,
            "offset": grid.offset,
            "shape": grid.shape,
            "rotation": grid.rotation,
            "shifted": grid.shifted_rows,
            "pitch": grid.nearest_distance,
        },
        "bins": bins and {"offset": bins.offset, "spacing": bins.spacing},
    }
    return content, f"{image.shape[1]} x {image.shape[0]} pixels{averaged}; 8 bits, up to {full:.3g}"


def _depth(estimate: xr.Dataset) -> Named:
    """Return a depth map as inverse distances, without depths of low confidence."""
    depth = np.asarray(estimate["depth"], dtype=np.float64)
    # Confidence above which a depth is shown.
    inverse = np.where(np.asarray(estimate["confidence"]) > 0.5, 1 / depth, np.nan)
    finite = inverse[np.isfinite(inverse)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    return {"picture": images.encode(inverse, 16, high or 1.0), "low": low, "high": high}


def _plain(distance: Any) -> Any:
    """Return distances as JSON values: infinity as text, unknown distances as None."""
    values = [
        None if math.isnan(value) else "inf" if math.isinf(value) else float(f"{value:.6g}")
        for value in np.atleast_1d(distance).tolist()
    ]
    return values if np.ndim(distance) else values[0]
