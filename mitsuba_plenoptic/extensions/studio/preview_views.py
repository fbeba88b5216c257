"""Views of a scene by a camera without its microlenses, through a thin lens or an objective, for previews."""

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import design
from ...camera import PlenopticCamera
from ...errors import refuse_if
from ...prescription import lens_data
from ...report import objective_image, photograph, photographic_sensor, telecentric_rays
from ...runtime import Array, Pair, Shape
from ...scene import world_ray

_FAR = 1e5
"""Distance in focal lengths that represents infinity."""


@dataclass(frozen=True)
class LensView:
    """The view through a thin lens of the camera's aperture; distances are in mm from the lens."""

    camera: PlenopticCamera

    # Of lengths that are printed: its name, and how many there are in a millimetre.
    unit = "mm"
    per_millimetre = 1.0
    depth_label = "mm from the main lens"
    sharp_label = "made sharp by refocusing"

    @property
    def focus(self) -> float:
        """Distance of the object plane on which the microlenses of the first type are focused."""
        camera = self.camera
        distance = design.best_distances(camera)[0]
        refuse_if(
            not camera.focal_length < distance,
            f"mla_distance = {camera.mla_distance:g}: no plane beyond the focal length {camera.focal_length:g} is in "
            "focus",
        )
        return min(distance, _FAR * camera.focal_length)

    @property
    def focus_label(self) -> str:
        """Name of the plane in focus."""
        return f"in focus at {self.in_units(self.focus)}"

    def sharp_range(self) -> Pair:
        """Return the range of refocusing, without diffraction."""
        return design.refocus_range(self.camera)

    def take(self, scene: Any, size: Shape, spp: int) -> Array:
        """Return the picture of the scene, with colours where the variant has them, by Mitsuba's thin lens."""
        lens = {"aperture_radius": self.camera.aperture_radius, "focus_distance": self.focus}
        colours = "luminance" if mi.is_monochromatic else "rgb"
        return photograph(scene, photographic_sensor(scene, self.camera, size, colours, type="thinlens", **lens), spp)

    def sight(self, scene: Any, size: Shape) -> Pair:
        """Return the rays through the centre of the pupil, one per pixel, and the transform of the camera to the world.

        The rays are those of Mitsuba's `perspective` sensor.
        """
        near = 1e-6 * self.focus
        pinhole = photographic_sensor(scene, self.camera, size, type="perspective", near_clip=near)
        x, y = _pixel_centres(size)
        rays, _ = pinhole.sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
        return rays, pinhole.world_transform()

    def is_focused(self, distance: Array) -> Array:
        """Return a mask of distances whose blur on the array is at most a lens wide."""
        camera = self.camera
        image = lens_data.image_distance(camera.focal_length, self.focus)
        blur = camera.aperture_diameter * np.abs(lens_data.defocus_factor(distance, image, camera.focal_length))
        return np.asarray(blur <= camera.row_pitch)

    def field(self, distance: float) -> Pair:
        """Return width and height of the field in mm, which grow with the distance before a thin lens."""
        columns, rows = self.camera.bin_count
        bin_size = self.camera.bin_size(distance)
        return columns * bin_size, rows * bin_size

    def field_in_units(self) -> str:
        """Return width and height of the field in the plane in focus as text with unit, at infinity as angles."""
        if self.in_units(self.focus) == self.in_units(math.inf):
            width, height = (math.degrees(2 * math.atan(extent / 2)) for extent in self.field(1.0))
            return f"{width:.4g} x {height:.4g} degrees"
        width, height = (extent * self.per_millimetre for extent in self.field(self.focus))
        return f"{width:.4g} x {height:.4g} {self.unit}"

    def size(self, columns: int) -> Shape:
        """Return columns and rows of the picture: whole pixels for each bin, and at least so many columns."""
        across, down = self.camera.bin_count
        width = -(-columns // across)
        return across * width, down * width

    def drawn_range(self, distances: Array) -> Pair:
        """Return the range over which the field is drawn: from the lens to the farthest of the visible points."""
        return 0.0, 1.15 * max(self.focus, float(np.percentile(distances, 99)) if distances.size else 0.0)

    def in_units(self, distance: float) -> str:
        """Return a distance as text with its unit, or the word for infinity."""
        far = distance >= _FAR * self.camera.focal_length
        return "infinity" if far else f"{distance * self.per_millimetre:.4g} {self.unit}"

    def between(self, near: float, far: float) -> str:
        """Return a range of distances as text with unit."""
        return f"{near * self.per_millimetre:.4g} to {self.in_units(far)}"


class MicroscopeView(LensView):
    """The view through an objective by telecentric rays from the stop; distances are from the native object plane."""

    unit = "um"
    per_millimetre = 1e3
    depth_label = "um beyond the native object plane"

    @property
    def sharp_label(self) -> str:  # type: ignore[override]
        """Name of the range of depths that are sharp."""
        return "sharp under each microlens" if self._objective.images_stop else LensView.sharp_label

    @property
    def focus(self) -> float:
        """Distance of the native object plane, which is in focus: 0."""
        return 0.0

    @property
    def focus_label(self) -> str:
        """Name of the plane in focus."""
        return "in focus in the native object plane"

    def field(self, distance: float) -> Pair:
        """Return width and height of the field, in the Fourier arrangement of the field stop or of one lens."""
        if not self._objective.images_stop:
            return super().field(distance)
        return (design.native_field(self.camera),) * 2

    def size(self, columns: int) -> Shape:
        """Return columns and rows of the picture, of which the square field of the Fourier arrangement has as many."""
        return (columns, columns) if self._objective.images_stop else super().size(columns)

    def sharp_range(self) -> Pair:
        """Return the range of depths that `design.depth_of_field` states."""
        return design.depth_of_field(self.camera)

    def take(self, scene: Any, size: Shape, spp: int) -> Array:
        """Return the picture through an objective, dark beyond the field stop."""
        return np.nan_to_num(objective_image(scene, self.camera, 0.0, spp, size, self.field(0.0)[0] / size[0]))

    def sight(self, scene: Any, size: Shape) -> Pair:
        """Return rays parallel to the axis."""
        # +x, to the left in the scene, is to the left in the picture.
        x, y = ((0.5 - at) * extent for at, extent in zip(_pixel_centres(size), self.field(0.0), strict=True))
        point, slope, is_open = telecentric_rays(self.camera, (x, y, 0.0), (mi.Float(0.0), mi.Float(0.0)))
        sensor = scene.sensors()[0]
        rays = mi.RayDifferential3f(world_ray(sensor, point, slope))
        # The field stop, if there is one, ends rays where they start.
        rays.maxt = dr.select(is_open, dr.inf, 0.0)
        return rays, sensor.world_transform()

    def is_focused(self, distance: Array) -> Array:
        """Return a mask of depths whose blur in the object is at most a bin wide."""
        steepest = math.tan(self._objective.half_angle)
        return 2 * np.abs(distance) * steepest <= self.camera.bin_size(0)

    def drawn_range(self, distances: Array) -> Pair:
        """Return a range that reaches as far before the native object plane as beyond it."""
        reach = np.abs([end for end in self.sharp_range() if math.isfinite(end)] + [*distances])
        half = 1.15 * max(float(np.max(reach, initial=0.0)), self.field(0.0)[0] / 4)
        return -half, half

    @property
    def _objective(self) -> Any:
        return self.camera.objective


def view_of(camera: PlenopticCamera) -> LensView:
    """Return the view of a camera: through a thin lens, or through an objective."""
    return LensView(camera) if camera.objective is None else MicroscopeView(camera)


def _pixel_centres(size: Shape) -> Pair:
    """Return the centres of all pixels, row by row, in fractions of the picture."""
    index = dr.arange(mi.UInt32, size[0] * size[1])
    row = index // size[0]
    return (index - row * size[0] + 0.5) / size[0], (row + 0.5) / size[1]
