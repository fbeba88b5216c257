"""Preview of a scene before capture: the view of its lens, the range in focus, and whether the camera suits it."""

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator
from scipy.spatial import ConvexHull

from ...camera import PlenopticCamera, Use, require_support
from ...report import images, plots
from ...runtime import Array
from .preview_views import LensView, view_of

# Columns of pictures at least, and samples of each of their pixels. Small luminous things blur widely through an
# objective, which takes more.
_COLUMNS = 320
_SPP = 16
_OBJECTIVE_SPP = 128

_SHARP = "#3fb4ff"
_FOCUS = "#ffb000"
"""Colours of what refocusing makes sharp and of what is in focus, and how opaque the tint of the latter is."""


@dataclass(frozen=True, eq=False)
class Preview:
    """View of a scene by a camera without its microlenses, with the depth at each pixel.

    Attributes
    ----------
    picture : (rows, columns[, 3]) array
        Radiance, in colour by a variant of colours, focused on the plane in focus.
    points : (rows, columns, 3) array
        Points seen from the middle of the lens, in the camera's frame: x to the left, y up, z the distance; NaN where
        there is nothing.
    shapes : (rows, columns) array
        Numbers of the shapes that are seen.
    view : LensView
        The camera's view.
    """

    picture: Array
    points: Array
    shapes: Array
    view: LensView

    @property
    def distance(self) -> Array:
        """Distances of the visible points along the axis, in the view's unit; NaN where nothing is visible."""
        return self.points[..., 2]

    @property
    def filled(self) -> float:
        """Fraction of the picture's width or height that the scene spans, whichever is larger."""
        finite = np.isfinite(self.distance)
        spans = [np.flatnonzero(finite.any(axis=axis)) for axis in (0, 1)]
        return max(
            float(np.ptp(span) + 1) / size if span.size else 0.0
            for span, size in zip(spans, finite.shape[::-1], strict=True)
        )


def preview_of(scene: Any, camera: PlenopticCamera) -> Preview:
    """Return the preview of a scene with its present camera."""
    camera.require_array("preview")
    require_support(camera, Use.ROUND_PUPILS)
    view = view_of(camera)
    size = view.size(_COLUMNS)
    picture = view.take(scene, size, _SPP if camera.objective is None else _OBJECTIVE_SPP)
    rays, to_world = view.sight(scene, size)
    hit = scene.ray_intersect(rays)
    point = to_world.inverse() @ hit.p
    points = np.array(dr.select(hit.is_valid(), point, dr.nan), dtype=np.float64).T.reshape(size[1], size[0], 3)
    shapes = np.array(dr.reinterpret_array(mi.UInt32, hit.shape)).reshape(size[::-1])
    return Preview(picture, points, shapes, view)


def framing_warnings(preview: Preview) -> list[str]:
    """Return warnings about the position of a scene in the picture, with fractions of the picture."""
    view = preview.view
    distance = preview.distance[np.isfinite(preview.distance)]
    if not distance.size:
        return ["nothing of the scene is in the picture"]
    warnings = []
    if preview.filled < 0.4:
        warnings.append(f"the scene spans {preview.filled:.2%} of the picture")
    near = float((distance <= view.camera.focal_length).mean())
    if near > 0 and view.camera.objective is None:
        warnings.append(
            f"{near:.0%} of what is seen is within the focal length of {view.camera.focal_length:g} mm, where nothing "
            "is in focus"
        )
    ends = view.sharp_range()
    sharp = float(((distance >= ends[0]) & (distance <= ends[1])).mean())
    if sharp < 0.5:
        warnings.append(
            f"what is seen is from {view.between(distance.min(), distance.max())}, and only {sharp:.0%} of it from "
            f"{view.between(*ends)}, which is {view.sharp_label}"
        )
    return warnings


@plots.styled
def preview_figure(title: str, preview: Preview) -> plots.Plot:
    """Return a figure of a preview, in focus tinted and within reach of refocusing outlined, and from above."""
    plot = plots.Plot(9.8, 4.9)
    ((axes, from_above),) = plot.panels(1, 2)
    rows, columns = preview.picture.shape[:2]
    # One line of the picture's width.
    named = title if len(title) <= 30 else f"{title[:27]}..."
    heading = f"{named or 'What the main lens sees'}, {preview.view.focus_label}"
    plots.show(axes, preview.picture, heading, peak=images.Brightness().peak([preview.picture]))
    if preview.view.in_units(preview.view.focus) != preview.view.in_units(math.inf):
        plots.scale_bar(axes, preview.view.field(preview.view.focus)[0], plots.IN_FOCUS)
    axes.set(frame_on=True, box_aspect=rows / columns, anchor="NW")
    # Tint the region in focus, and draw outlines around it and around regions that refocusing makes sharp.
    distance = preview.distance
    near, far = preview.view.sharp_range()
    in_focus = preview.view.is_focused(distance)
    for shown_part, colour in (((distance >= near) & (distance <= far), _SHARP), (in_focus, _FOCUS)):
        if shown_part.any() and not shown_part.all():
            axes.contour(shown_part.astype(float), levels=[0.5], colors=[colour], linewidths=1.2)
    axes.imshow(np.where(in_focus[..., None], to_rgba(_FOCUS, 0.35), 0.0), interpolation="nearest", aspect="auto")
    _draw_from_above(from_above, preview)
    return plot


def _draw_from_above(axes: Axes, preview: Preview) -> None:
    """Draw the visible points as seen from above, with the borders of the field."""
    view = preview.view
    focus = preview.view.focus
    points = preview.points[np.isfinite(preview.distance)]
    shapes = preview.shapes[np.isfinite(preview.distance)]
    near, far = view.sharp_range()
    start, reach = view.drawn_range(points[:, 2])
    if near < reach:
        visible = max(near, start), min(far, reach)
        axes.axvspan(*visible, color=_SHARP, alpha=0.25, linewidth=0, label=view.sharp_label)
    axes.axvline(focus, color=_FOCUS, label=view.focus_label)
    for side in (-0.5, 0.5):
        border = [side * view.field(end)[0] for end in (start, reach)]
        axes.plot([start, reach], border, color="#667080", linewidth=0.8)
    for shape in np.unique(shapes):
        of_shape = points[shapes == shape][:, [2, 0]]
        if len(of_shape) > 2:
            # Joggled, as walls that face the camera are lines in the plan.
            corners = of_shape[ConvexHull(of_shape, qhull_options="QJ").vertices]
            axes.add_patch(Polygon(corners, fill=False, edgecolor="#1b1f24", linewidth=0.8))
    axes.set_xlim(start, reach)
    for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        ticks = [tick for tick in MaxNLocator(6).tick_values(*limits) if limits[0] < tick < limits[1]]
        axis.set_ticks(ticks, [f"{tick * view.per_millimetre:g}" for tick in ticks], fontsize=8)
    axes.set_xlabel(view.depth_label, size=8)
    axes.yaxis.tick_right()
    axes.set_title(f"From above, {view.unit} across; outlines: what is seen; grey: borders", size=9, loc="left", pad=6)
    axes.legend(fontsize=7, loc="upper left", framealpha=0.9)
