"""Fit of a camera to its white picture: array, pupil over the field, blur, stray light, brightness of lenses."""

from dataclasses import dataclass

import numpy as np
import scipy.ndimage

from ...camera import PlenopticCamera
from ...detector import SHARP
from ...errors import naming, refuse_if, require_wavelength
from ...io import Capture
from ...runtime import Array, Progress, Sizes, single_threaded_blas
from .array_fit import ArrayFit, fit_array, lattice_index, places, require_alike
from .field_fit import ZONE_LENSES, FieldNumbers, Judgement, WhiteRecording, zones_of
from .fitted_camera import fitted_camera
from .micro_image import MicroImageModel, PupilNumbers
from .white_centres import find_centres
from .white_frames import WhiteFrame


@dataclass(frozen=True)
class WhiteFit:
    """A camera fitted to its white picture, and how well lenses that were withheld from the fit agree.

    Attributes
    ----------
    camera : PlenopticCamera
        The fitted camera.
    wavelength : float or None
        Wavelength of the fit in nanometres; None for a fit by rays.
    frame : WhiteFrame
        The picture, with the pixels that count.
    array : ArrayFit
        Pitches, rotation, offset and warp.
    field : FieldNumbers
        The pupil over the field, blur and stray light.
    deviations : dict of str to array
        Standard deviations of the field's coefficients, from lenses drawn again.
    place, lens : (n, 2) arrays
        Fitted place in pixels, where the first pixel's centre is 0, and index along and across the rows, of each whole
        micro-image.
    off_array : (n, 2) array
        Places less those of the fitted array, in pixels.
    brightness : (n,) array
        Light in the middle of each micro-image, in units of the picture.
    withheld : (n,) bool array
        Lenses that the fit has not seen.
    judgement : Judgement
        Agreement of the withheld lenses.
    """

    camera: PlenopticCamera
    wavelength: float | None
    frame: WhiteFrame
    array: ArrayFit
    field: FieldNumbers
    deviations: dict[str, Array]
    place: Array
    lens: Array
    off_array: Array
    brightness: Array
    withheld: Array
    judgement: Judgement

    def lens_index(self) -> dict[str, object]:
        """Return how the centres that `find_centres` counts are the camera's lenses, as files of cameras state."""
        along, row = self.array.nearest
        # Rows are shifted by half a pitch where indices are not whole.
        odd, even = (float(self.lens[self.lens[:, 1] % 2 == parity, 0][0] % 1) for parity in (1, 0))
        return {"odd_rows": odd - even, "row_sign": 1, "first": [int(along // 1), int(row)]}


@single_threaded_blas()
def fit_white(
    white: Array | Capture,
    camera: PlenopticCamera,
    *,
    dark: Array | None = None,
    wavelength: float | None = 550.0,
    seed: int = 0,
    progress: Progress | None = None,
) -> WhiteFit:
    """Fit a camera to a picture of something evenly white.

    Parameters
    ----------
    white : (rows, columns) array or Capture
        Values of the sensor, proportional to light. Many with the largest one are saturated, but in a computed capture.
    camera : PlenopticCamera
        The camera as it is known: main lens, microlenses' focal length, their distance to the detector, pixels. The
        size of the picture replaces its resolution, with pixels of the same size.
    dark : (rows, columns) array, optional
        A picture without light.
    wavelength : float, optional
        Wavelength in nanometres; None fits by rays.
    seed : int
        Seed that chooses the third of the lenses to be withheld.
    progress : callable, optional
        Called with the finished and the whole number of steps.

    Returns
    -------
    WhiteFit

    Raises
    ------
    InputError
        If the pictures cannot be of such a camera, or are not evenly white.
    """
    camera.require_array("calibrate")
    show = progress or (lambda done, total: None)

    def quarter(first: int) -> Progress:
        return lambda done, total: show(done + first * total, 4 * total)

    if wavelength is not None:
        require_wavelength(wavelength)
    frame = WhiteFrame.of(white, dark)
    generator = np.random.default_rng(seed)
    size = frame.light.shape[::-1]
    plain = camera.replace(
        mla_warp=(), mla_tilt=(0.0, 0.0), mla_transmissions=None, vignetting=None, pupil_apodisation=(0.0, 0.0), **SHARP
    )
    camera = of_size(plain, size)
    # What the lenses' light cannot be is known before their places are.
    MicroImageModel(camera, wavelength)
    # Saturated and defective pixels have the median of their neighbours.
    filled = np.where(frame.good, frame.light, scipy.ndimage.median_filter(frame.light, 5))
    centres = find_centres(filled, like=camera.lattice)
    require_alike(centres.grid, camera)
    sure = ~centres.doubtful
    array = fit_array(centres.pixel[sure], lattice_index(centres.grid, centres.lens)[sure], camera)
    camera = camera.replace(**array.lattice_parameters())
    lens = lattice_index(centres.grid, np.indices(centres.grid.shape)[::-1].reshape(2, -1).T)
    position = places(array, lens, camera)
    recording = WhiteRecording(frame, camera, MicroImageModel(camera, wavelength))
    complete = whole_lenses(recording, position)
    position = position[complete]
    lens = lens[complete]
    refuse_if(len(position) < 16, f"white: {len(position)} whole micro-images are seen: at least 16 are needed")
    withheld = generator.random(len(position)) < (1 / 3)
    # First one pupil for all lenses, from a few of them, and even: a rim that falls off early resembles a wider one.
    start = PupilNumbers(camera.pupil_radius / camera.pupil_step, blur=0.7, stray=0.02)
    seen = np.flatnonzero(~withheld)
    few = [generator.choice(seen, min(len(seen), 4 * ZONE_LENSES), replace=False)]
    for zero in (("apodisation_2", "apodisation_4"), ()):
        field = FieldNumbers(size, 0, start, zero)
        with naming(
            "white: it is no white picture by this camera, or the camera's numbers, as its aperture, are far off"
        ):
            recording.fit(position, few, field, quarter(0))
        start = PupilNumbers(*field.values(position[:1])[0])
    field = FieldNumbers(size, int((~withheld).sum()), start)
    zones = zones_of(position, ~withheld, ZONE_LENSES, generator)
    # What all lenses have alike is told best where the field is known, which then follows.
    recording.fit(position, zones, field, quarter(1))
    recording.fit_shape(position, zones, field)
    deviations = field.deviations(recording.fit(position, zones, field, quarter(1)), generator)
    judged = recording.judged(position, zones_of(position, np.ones(len(position), bool)), field, quarter(2))
    # Places become those of the array alone, fitted to lenses that are not withheld.
    array = fit_array(judged.place[~withheld], lens[~withheld], camera)
    for name in ("centre_x", "centre_y"):
        field.coefficients[name] = np.zeros_like(field.coefficients[name])
    at_array = places(array, lens, camera)
    judgement = recording.judged(at_array, zones_of(at_array, withheld), field, quarter(3))
    refuse_if(
        judgement.structure > 0.035 or judgement.outliers > 0.05,
        f"white: its micro-images differ from those of something evenly white by {judgement.structure:.1%} of their "
        f"light, apart from noise (at most 3.5%), and by more at {judgement.outliers:.1%} of the "
        "pixels (at most 5%): it is no white picture, or not by this camera",
    )
    blur, stray = (float(field.coefficients[name][0]) for name in ("blur", "stray"))
    apart = camera.lattice.nearest_distance * camera.image_growth / camera.pixel_size
    refuse_if(
        blur >= 0.1 * apart or stray < -0.01,
        f"white: the fit failed, with a blur of {blur:.3g} pixels (below 0.1 of a lens, "
        f"{0.1 * apart:.3g}) and stray light of {stray:.2g} (not negative): the camera's numbers or the "
        "dark picture are wrong",
    )
    return WhiteFit(
        camera=fitted_camera(recording.model, camera, array, field, at_array, lens, judged.brightness),
        wavelength=wavelength,
        frame=frame,
        array=array,
        field=field,
        deviations=deviations,
        place=judged.place,
        lens=lens,
        off_array=judged.place - at_array,
        brightness=judged.brightness,
        withheld=withheld,
        judgement=judgement,
    )


def whole_lenses(recording: WhiteRecording, position: Array) -> Array:
    """Return which lenses at places (n, 2) have their cells within the picture, and light there."""
    camera = recording.camera
    scale = camera.image_growth / camera.pixel_size
    corners = position[:, None] + camera.lattice.cell_corners() * scale + 0.5
    complete = np.asarray(((corners >= 0) & (corners <= recording.frame.light.shape[::-1])).all((1, 2)))
    first, value, _, _ = recording.pixels(position[complete])
    pixels = np.diff(first)
    light = np.bincount(np.repeat(np.arange(len(pixels)), pixels), value, len(pixels)) / np.maximum(pixels, 1)
    complete[complete] = (pixels >= 0.5 * camera.lattice.cell_area * scale**2) & (light > 0.1 * np.median(light))
    return complete


def of_size(camera: PlenopticCamera, size: Sizes) -> PlenopticCamera:
    """Return a camera with a full film of columns and rows, and pixels as large as before."""
    if camera.crop_size == size and not camera.is_cropped:
        return camera
    refuse_if(
        camera.crop_size == size[::-1],
        f"white of {size[0]} x {size[1]} pixels: the camera has {size[1]} x {size[0]}: is the picture turned?",
    )
    width = camera.pixel_size * size[0]
    return camera.replace(resolution=size, detector_width=width, crop_offset=(0, 0), crop_size=size)
