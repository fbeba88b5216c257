"""Commonly used quantities that follow from a camera's parameters: its pupil, lattice, pixels and bins."""

import math
from functools import cached_property
from typing import Any

import numpy as np

from ..array import (
    NO_LATTICE,
    Displacement,
    FigureError,
    Lattice,
    Lenslet,
    MicrolensShape,
    Paraboloid,
    deviates,
    make_lattice,
    random_figure_error,
)
from ..errors import InputError, refuse_if, require_number
from ..prescription import THIN, Collimator, LensData, Objective, Prescription, defocus_factor, even_count
from ..runtime import Array, Numbers, Pair, Shape, minimum, select, take
from .aperture import Apodised, Opening, Round
from .entry import one_if_equal, one_if_single, record
from .parameters import CameraParameters

NO_ARRAY_HERE = f"mla_lattice = {NO_LATTICE}: the camera has no microlens array"
"""Beginning of the messages about what a camera without an array has not or cannot do."""


@record
class CameraGeometry(CameraParameters):
    """A camera's parameters, with the quantities that follow from them; lengths in millimetres."""

    # -- main lens -----------------------------------------------------------------------------------

    @property
    def objective(self) -> Objective | None:
        """The main lens if it is a microscope's objective, otherwise None."""
        return self.main_lens if isinstance(self.main_lens, Objective) else None

    @property
    def prescription(self) -> Prescription | None:
        """The main lens if it is given by its surfaces, otherwise None."""
        return self.main_lens if isinstance(self.main_lens, Prescription) else None

    @property
    def lens_data(self) -> LensData:
        """The main lens, with one interface for all kinds of lenses, thin ones included."""
        return self.main_lens or THIN

    @property
    def pupil_distance(self) -> float:
        """Distance from the exit pupil to the MLA in millimetres: :math:`b` for a thin lens, which is its exit pupil.

        Behind an objective, the image of the stop through the lens before the array is at infinity. The value is then
        the focal length of that lens: positions on the stop divided by it are directions at the array.
        """
        return self.mla_distance + self.lens_data.exit_pupil(self.focal_length)[0]

    @property
    def pupil_radius(self) -> float:
        """Radius of the exit pupil near the axis, in millimetres: :math:`D_1/2` for a thin lens."""
        return self.aperture_radius * self.lens_data.exit_pupil(self.focal_length)[1]

    @property
    def aperture_diameter(self) -> float:
        """Diameter :math:`D_1` of the main lens in millimetres."""
        return 2 * self.aperture_radius

    @property
    def aperture(self) -> Opening:
        """The aperture over the pupil's radius: blades, a picture, an apodised disc, or a disc."""
        apodised = Apodised(*self.pupil_apodisation) if any(self.pupil_apodisation) else Round()
        return self.aperture_blades or self.aperture_image or apodised

    @property
    def has_even_pupil(self) -> bool:
        """Whether all of the pupil's disc is equally open to all places of the array."""
        return self.aperture == Round() and self.vignetting is None

    def pupil_power(self, pupil: Pair, position: Pair) -> Any:
        """Return the part of the power that passes pupil points, over its radius, to places of the array.

        It is the product of all layers: blades, a picture or an apodisation, and vignetting.
        """
        inside, power = self.pupil_outline(pupil, position)
        return select(inside >= 0, power, 0.0)

    def pupil_outline(self, pupil: Pair, position: Pair) -> Pair:
        """Return how far points are inside all edges, over the pupil's radius, and the power as if edges were wider."""
        inside, power = self.aperture.outline(*pupil)
        if self.vignetting is None:
            return inside, power
        within, passed = self.vignetting.outline(*pupil, *position)
        return minimum(inside, within), power * passed

    @property
    def f_number(self) -> float:
        """Focal length of the main lens divided by its diameter."""
        return self.focal_length / self.aperture_diameter

    def defocus(self, distance: float) -> float:
        """Return the signed ratio of the diameters, on the MLA and on the main lens, of an on-axis point's light cone.

        :math:`s = 1 + b/g - b/f_1`: zero in focus, positive for nearer points.

        Parameters
        ----------
        distance : float
            Object distance from the main lens in millimetres.
        """
        self.require_lens("defocus")
        refuse_if(distance == 0, "distance = 0: the point lies in the main lens; it has no image")
        return defocus_factor(distance, self.mla_distance, self.focal_length)

    def blur_diameter(self, distance: float) -> float:
        """Return the diameter in mm of the geometric blur of a point at `distance` on the MLA: :math:`D_1 |s|`."""
        return self.lens_data.image_blur(self, distance)

    # -- detector and lattice ------------------------------------------------------------------------

    @property
    def has_array(self) -> bool:
        """Whether the camera has a microlens array; otherwise its detector is at `mla_distance`."""
        return self.mla_lattice != NO_LATTICE

    def require_array(self, what: str) -> None:
        """Refuse a camera without a microlens array, for a function or quantity, `what`, that needs one."""
        refuse_if(not self.has_array, f"{what}: {NO_ARRAY_HERE}")

    @property
    def refocuses(self) -> bool:
        """Whether captures can be refocused: those of an array, unless it is in the image of a telescope's pupil."""
        return self.has_array and not isinstance(self.main_lens, Collimator)

    @property
    def figure_error(self) -> FigureError | None:
        """The random optical path over the whole array, or None if it has none."""
        size, length = self.mla_figure_error
        return random_figure_error(size, length, self.mla_seed) if size else None

    @cached_property
    def lattice(self) -> Lattice:
        """The microlens lattice: positions of the lenses' centres and shape of their apertures."""
        self.require_array("lattice")
        return make_lattice(
            self.mla_lattice,
            self.mla_pitches,
            rotation=self.mla_rotation,
            offset=self.mla_offset,
            aperture=self.mla_aperture,
            fill=self.mla_fill,
            displacement=self.displacement(self.detector_distance),
        )

    @cached_property
    def microlens(self) -> MicrolensShape:
        """The shape of the microlenses, a paraboloid where no `mla_shape` is given."""
        return self.mla_shape or Paraboloid(self.reduced_focal_lengths[0])

    def array_height(self, x: Any, y: Any) -> Any:
        """Return the height in mm of a tilted array at a position: towards the main lens, relative to the axis."""
        across, up = (math.tan(math.radians(angle)) for angle in self.mla_tilt)
        return x * across + y * up if across or up else 0.0

    def tilted_growth(self, height: Any) -> Pair:
        """Return the nearness to the pupil of lenses at a height, and the size of their images, over an upright's."""
        # Chief rays behind an objective are parallel to the axis.
        nearer = 1 - (self.image_growth > 1) * height / self.pupil_distance
        return nearer, (1 + height / self.detector_distance) / nearer

    @property
    def chief_warp(self) -> Numbers:
        """Displacement of the places where chief rays of lenses cross the upright array: `mla_warp`, and of a tilt."""
        warp = np.array(self.mla_warp or np.zeros(14)).reshape(2, -1)
        # A tilt moves lenses by c h / b, where h is linear in c.
        rise = np.tan(np.deg2rad(self.mla_tilt)) * (self.image_growth > 1) / self.pupil_distance
        warp[0, :2] += rise
        warp[1, 1:3] += rise
        return tuple(warp.ravel().tolist()) if warp.any() else ()

    def focal_factor(self, i: Any, j: Any) -> Any:
        """Return the factor on the focal length of an irregular lens."""
        return 1 + self.mla_jitter[1] * deviates(self.mla_seed, i, j)[2]

    def lenslet(self, i: Any, j: Any, lattice: Lattice | None = None, focal_lengths: Any = None) -> Lenslet:
        """Return the lenses of some indices, floats, NumPy or Dr.Jit arrays.

        A lattice, and one focal length in air or one for each type of lens, may stand for the camera's own.
        """
        for name, index in {"i": i, "j": j}.items():
            if not hasattr(index, "shape"):
                require_number(name, index)
        lattice = self.lattice if lattice is None else lattice
        focal_length = np.array(self.reduced_focal_lengths) if focal_lengths is None else focal_lengths
        centre = lattice.centre(i, j)
        if len(self.mla_focal_lengths) > 1:
            focal_length = take(focal_length, lattice.lens_type(i, j))
        elif isinstance(focal_length, np.ndarray):
            focal_length = float(focal_length[0])
        if self.mla_jitter[1]:
            focal_length = focal_length * self.focal_factor(i, j)
        table = self.mla_transmissions
        return Lenslet(
            centre, focal_length, self.array_height(*centre), 1.0 if table is None else table.at(lattice, i, j)
        )

    def displacement(self, detector_distance: Any) -> Displacement | None:
        """Return the displacement of the lenses from their regular positions; None for a regular array.

        Parameters
        ----------
        detector_distance : float or Dr.Jit array
            Distance in mm from the array to the detector, over which `mla_cra` is kept.
        """
        self.require_array("displacement")
        displacement = Displacement(
            warp=self.mla_warp,
            chief_rays=self.mla_cra,
            distance=detector_distance,
            medium=self.mla_medium,
            deviation=self.mla_jitter[0],
            seed=self.mla_seed,
        )
        return displacement if displacement.is_smooth or displacement.deviation else None

    @cached_property
    def most_displaced(self) -> Pair:
        """Largest smooth displacement of a lens over the detector in mm, and largest change per mm; 0 if regular."""
        half = np.array([self.detector_width, self.detector_height]) / 2
        moved = self.lattice.displacement
        return (0.0, 0.0) if moved is None else moved.most_smooth(-half, half)

    def nearer(self, reach: float) -> float:
        """Return by how many mm displacements and tilt bring lenses nearer that light a point from `reach` away."""
        across, up = np.abs(np.tan(np.deg2rad(self.mla_tilt)))
        rise = float(self.detector_width * across + self.detector_height * up) / 2
        # Where the array is far from the detector, micro-images are larger.
        change = reach * rise / self.detector_distance
        if (moved := self.lattice.displacement) is None:
            return change
        return change + moved.farthest_irregular + self.most_displaced[1] * (reach + self.lattice.cell_reach)

    @property
    def lenses_like_bins(self) -> bool:
        """Whether each lens is an upright square as large as a bin, without gaps; bins and lenses may be shifted."""
        lattice = self.lattice
        return lattice.separable and lattice.fills and lattice.aspect == 1

    @property
    def lenses_are_bins(self) -> bool:
        """Whether each bin coincides with the lens of the same number."""
        return self.lenses_like_bins and not any(self.mla_offset)

    @property
    def mla_pitch(self) -> float | Numbers:
        """Pitch :math:`D_2` of the microlenses in mm, as it is given: of two, that along the rows comes first."""
        self.require_array("mla_pitch")
        return one_if_equal(self.mla_pitches)

    @property
    def row_pitch(self) -> float:
        """Pitch of the microlenses along their rows in mm, and width of a bin of reconstructions."""
        return float(np.ravel(self.mla_pitch)[0])

    @property
    def mla_focal_length(self) -> float | Numbers:
        """Focal length :math:`f_2` of a microlens in millimetres, or of each of three kinds."""
        self.require_array("mla_focal_length")
        return one_if_single(self.mla_focal_lengths)

    @property
    def reduced_distance(self) -> float:
        """Distance :math:`z / n` in mm from the MLA to the detector, reduced by the index of the medium between them.

        Light near the axis passes the medium as it passes this distance of air.
        """
        self.require_array("reduced_distance")
        return self.detector_distance / self.mla_medium

    @property
    def reduced_focal_lengths(self) -> Numbers:
        """Focal lengths :math:`f_2 / n` in mm of the microlenses in air, the reciprocals of their powers."""
        self.require_array("reduced_focal_lengths")
        return tuple(length / self.mla_medium for length in self.mla_focal_lengths)

    def medium_wavelength(self, wavelength: float) -> float:
        """Return the wavelength directly before the detector of light with this wavelength in air."""
        return wavelength / self.space_behind[1]

    @property
    def space_behind(self) -> Pair:
        """Distance in mm from the MLA to the detector, and index of the medium there; 0 and 1 without an array."""
        return (self.detector_distance, self.mla_medium) if self.has_array else (0.0, 1.0)

    @property
    def image_samples(self) -> tuple[str, float]:
        """What divides the image behind the main lens into samples, microlenses or pixels, and their width in mm."""
        return ("microlenses", min(self.mla_pitches)) if self.has_array else ("pixels", self.pixel_size)

    @property
    def pixel_size(self) -> float:
        """Width of a pixel in millimetres."""
        return self.detector_width / self.resolution[0]

    @property
    def pupil_step(self) -> float:
        """Width in mm of a pixel projected onto the pupil through its lens's centre: :math:`n b / z` times a pixel."""
        return self.pixel_size * self.pupil_distance / self.reduced_distance

    @property
    def lit_radius(self) -> float:
        """Radius in the pupil within which the projected centres of lit pixels lie: pupil plus half a pixel, in mm."""
        return self.pupil_radius + self.pupil_step / 2

    def pupil_shift(self, mla_focal_length: float, height: float = 0.0) -> float:
        r"""Return the shift of the pupil point seen by a detector point, per shift of the point on the microlens.

        :math:`\kappa = 1 + n b/z - n b/f_2`, which is 1 for :math:`z = f_2`. Behind an objective, whose stop all lenses
        see in the same directions, it is smaller by 1. A lens of a tilted array may have a height in mm.
        """
        power = 1 / (self.detector_distance + height) - 1 / mla_focal_length
        return self.lens_data.converges + self.mla_medium * (self.pupil_distance - height) * power

    @property
    def detector_height(self) -> float:
        """Height of the full detector in millimetres."""
        return self.pixel_size * self.resolution[1]

    @property
    def shape(self) -> Shape:
        """Rows and columns of the recorded image."""
        return self.crop_size[1], self.crop_size[0]

    def pixel_coordinates(self, axis: int) -> Array:
        """Return the coordinates in millimetres of the recorded pixels' centres along x (axis 0) or y (axis 1)."""
        pixel = np.arange(self.crop_size[axis]) + self.crop_offset[axis] + 0.5
        return (pixel - self.resolution[axis] / 2) * self.pixel_size

    @property
    def is_cropped(self) -> bool:
        """Whether less than the full detector is recorded."""
        return self.crop_size != self.resolution

    @property
    def pixels_per_lens(self) -> float:
        """Microlens pitch in pixels, the shorter one if there are two; it need not be an integer."""
        self.require_array("pixels_per_lens")
        return min(self.mla_pitches) / self.pixel_size

    def require_resolved(self) -> None:
        """Refuse a camera whose lenses are narrower than a pixel, for computations that proceed lens by lens."""
        if self.pixels_per_lens < 1:
            raise InputError(
                f"mla_pitch = {min(self.mla_pitches):g}: it is less than a pixel of {self.pixel_size:g}, so that no "
                "micro-image is resolved"
            )

    def require_lens(self, what: str) -> None:
        """Refuse a camera with an objective, for a quantity, `what`, that only lenses at a finite distance have."""
        refuse_if(
            not self.lens_data.converges,
            f"main_lens = {self.lens_data.label}: {what} is not defined behind an objective; "
            "mitsuba_plenoptic.design has native_field and resolution_limit",
        )

    @property
    def bin_count(self) -> Shape:
        """Columns and rows of bins of a reconstruction: squares of one lens pitch that fit the detector.

        The counts are rounded to even integers, so that the corner of four bins lies on the axis, as does that of four
        lenses of the default lattice. The bins do not depend on the lattice. In the Fourier arrangement each lens sees
        the whole object, and the count is that of the pixels along a pitch.
        """
        return self.lens_data.bin_count(self)

    @property
    def lens_count(self) -> Shape:
        """Count of lenses in a row of the lattice across the full detector, and of rows down the detector.

        A rotated lattice has as many lenses on the same area.
        """
        columns, rows = (even_count(width, self.row_pitch) for width in (self.detector_width, self.detector_height))
        if self.lattice.row_distance != self.row_pitch:
            rows = max(1, round(self.detector_height / self.lattice.row_distance))
        return columns, rows

    @property
    def micro_image_diameter(self) -> float:
        """Diameter in millimetres of the main lens's image under one microlens, :math:`D_1 z / n b`."""
        return 2 * self.pupil_radius * self.reduced_distance / self.pupil_distance

    @property
    def micro_image_pitch(self) -> float:
        """Distance in mm of neighbouring micro-images of a row: :math:`D_2 (b + z/n) / b`; behind an objective D2."""
        return self.row_pitch * self.image_growth

    @property
    def image_growth(self) -> float:
        """Pitch of micro-images over that of lenses: :math:`(b + z/n) / b`; 1 behind an objective or for no array."""
        distance, medium = self.space_behind
        return 1 + distance / medium / self.pupil_distance if self.lens_data.converges else 1.0

    # -- object side ---------------------------------------------------------------------------------

    def pixel_in_object(self, distance: float) -> float:
        """Return the width in mm of a pixel of an ordinary camera in an object plane, in radians at infinity."""
        return self.pixel_size * (1.0 if np.isinf(distance) else distance) / self.mla_distance

    def bin_size(self, distance: float) -> float:
        """Return the width in the object plane of one bin of a reconstruction, :math:`D_2 g / b`, in millimetres.

        With an objective the width is :math:`D_2 / M` at all depths; in the Fourier arrangement it is one pixel in the
        object.

        Parameters
        ----------
        distance : float
            Object distance from the main lens in millimetres.
        """
        return self.lens_data.bin_size(self, distance)


def has_small_lenses(camera: CameraGeometry, wavelength: float) -> bool:
    """Return whether a camera's lenses are so small that captures need the responses of photodiodes."""
    # Paraxial kernels do not hold for pitches below 20 wavelengths, which are in nanometres.
    return camera.has_array and min(camera.mla_pitches) < 20 * wavelength * 1e-6
