"""The paper's statements on limits, each with a verdict: pixels against range, deconvolution, plain loops.

The first two verdicts follow from the camera's closed forms (`mitsuba_plenoptic.design`), which cases of `tools/bench`
compare with captures: `arrays.pixels-and-range`, `deconvolution.contrast` and `deconvolution.fine-lines`.
"""

import itertools
import math
import time
from dataclasses import dataclass

import numpy as np

from ... import design
from ...camera import PlenopticCamera
from ...prescription import lens_data
from ...refocus import pupil_radius, ray_sums
from ...runtime import Array, Pair
from .claims import CONFIRMED, DIFFERS, PAPER_RESOLUTION, PAPER_SECONDS, PARTLY, Claim, verdict


@dataclass(frozen=True)
class FocusedCamera:
    """A camera of a given virtual depth, with its samples across the field and the distances that have them."""

    camera: PlenopticCamera
    virtual_depth: float
    pixels: float
    near: float
    far: float

    @property
    def range(self) -> float:
        """Range of distances in dioptres, which is finite for distances up to infinity."""
        return 1e3 / self.near - 1e3 / self.far


def focused_cameras(camera: PlenopticCamera, wavelength: float) -> list[FocusedCamera]:
    """Return focused cameras derived from an unfocused camera, from fine to coarse, and the unfocused camera.

    All have the same main lens, pixels and plane in focus, where their samples are finest. Within their range lenses
    are sharp (`design.depth_ranges`) and give at least half as many. The unfocused one has a sample per lens.
    """
    focus = camera.focus_distance
    z = camera.detector_distance
    image = lens_data.image_distance(camera.focal_length, focus)
    cameras = []
    for depth in (3.0, 4.0, 6.0, 8.0):
        a = depth * z
        focused = camera.replace(mla_distance=image + a, mla_focal_length=1 / (1 / a + 1 / z))
        pixels = design.effective_resolution(focused, focus, wavelength).columns
        ends = design.depth_ranges(focused, wavelength)[0]
        if ends is not None:
            inverse = np.linspace(1 / ends[0], 1 / ends[1], 400)
            sharp = (1 / inverse[inverse > 0]).tolist()
            fine = [g for g in sharp if design.effective_resolution(focused, g, wavelength).columns >= pixels / 2]
            cameras.append(FocusedCamera(focused, depth, pixels, fine[0], fine[-1]))
    lenses = float(camera.bin_count[0])
    return [*cameras, FocusedCamera(camera, math.inf, lenses, *design.refocus_range(camera, wavelength))]


def check_limits(camera: PlenopticCamera, wavelength: float, plain_seconds: float, ray_seconds: float) -> list[Claim]:
    """Return verdicts on limits, from the camera and from seconds of a plain loop and of the ray method on one core."""
    distance, fraction = deconvolved_fraction(camera, wavelength)
    paper = PAPER_SECONDS["ray"]
    theirs, ours = (f"{columns} x {rows}" for columns, rows in (PAPER_RESOLUTION, camera.resolution))
    return [
        pixels_against_range(focused_cameras(camera, wavelength)),
        Claim(
            "Out of focus, deconvolution brings back almost the resolution of the sensor.",
            f"At best {fraction:.0%} of it, at {distance:.0f} mm. In focus {1 / camera.pixels_per_lens:.0%}, one "
            "sample per lens.",
            CONFIRMED if fraction >= 0.8 else PARTLY if fraction >= 0.5 else DIFFERS,
            "Almost is at least 80% of the lines that the pixels would resolve without microlenses. In "
            "focus a lens sums the light of one bin, whose details cannot be separated. Between the stated plane and "
            "focus lenses see nearly the same; beyond it, diffraction by the microlenses and the pixels limit what is "
            "resolved.",
        ),
        Claim(
            f"Without special optimization, reconstruction by rays takes {paper:.0f} s.",
            f"A loop over {theirs} pixels in Python takes {plain_seconds:.2g} s on one core. Our reconstruction of "
            f"{ours} pixels takes {ray_seconds:.2g} s.",
            CONFIRMED if plain_seconds * 5.0 >= paper else DIFFERS,
            "Confirmed if the loop, on a core of about 2012, which counts as 5 times slower, takes as long. It "
            "follows one ray per pixel and gives the sums of our reconstruction. It is timed on the pixels of some "
            "rows.",
        ),
    ]


def pixels_against_range(cameras: list[FocusedCamera]) -> Claim:
    """Return the verdict on the price of more pixels, from cameras in the order of their pixels."""
    ends = ["infinity" if math.isinf(finer.far) else f"{finer.far:.0f} mm" for finer in cameras]
    reached = [f"{finer.pixels:.0f} from {finer.near:.0f} to {end}" for finer, end in zip(cameras, ends, strict=True)]
    return Claim(
        "Focused cameras refocus to more pixels than lenses, at the price of the range of distances.",
        f"Pixels across, and where they are reached: {'; '.join(reached)}.",
        verdict([fine.range < coarse.range for fine, coarse in itertools.pairwise(cameras)]),
        "Cameras of this main lens, array and detector, focused on the same plane, with virtual depths of "
        f"{', '.join(f'{finer.virtual_depth:g}' for finer in cameras[:-1])}; the last is the unfocused one, with a "
        "pixel per lens. The price is paid if each finer camera has the narrower range, in dioptres.",
    )


def deconvolved_fraction(camera: PlenopticCamera, wavelength: float) -> Pair:
    """Return the distance at which deconvolution resolves most of the bare sensor's lines, and their fraction."""
    fractions = {}
    for distance in np.geomspace(0.6 * camera.focus_distance, 3 * camera.focus_distance, 800).tolist():
        limit = design.resolution_limit(camera, distance, wavelength)
        sensor = camera.mla_distance / (2 * camera.pixel_size * distance)
        fractions[distance] = 0.0 if limit.in_focus else limit.frequency / sensor
    return max(fractions.items(), key=lambda pair: pair[1])


def plain_seconds(camera: PlenopticCamera, distance: float) -> float:
    """Return the processor time of a plain loop over two rows of lenses, scaled to the paper's pixels.

    The shortest of several runs counts, since other work on the processor delays it least. A RuntimeError tells that
    the loop's sums are not those of our reconstruction.
    """
    columns, rows = camera.resolution
    count = min(rows, round(2 * camera.pixels_per_lens))
    cut = camera.replace(crop_offset=(0, (rows - count) // 2), crop_size=(columns, count))
    image = np.random.default_rng(0).random((count, columns), np.float32)
    seconds = []
    for _ in range(3):
        start = time.process_time()
        sums = run_plain_sums(image, cut, distance)
        seconds.append(time.process_time() - start)
    ours = ray_sums(image[..., None], cut, distance, pupil_radius(cut), "point", 1)[..., 0]
    # Relative difference of sums that are the same: a pixel on the border of two bins may go to either.
    if np.abs(sums - ours).sum() > 1e-3 * ours.sum():
        raise RuntimeError("the plain loop and our reconstruction give different sums")
    return min(seconds) * math.prod(PAPER_RESOLUTION) / image.size


def plain_sums(
    image: Array,
    x: Array,
    y: Array,
    distances: tuple[float, float, float, float],
    pitch: float,
    radius: float,
    bins: Array,
) -> None:
    """Add each pixel of an image to the bin that the pixel's ray meets, in one plain loop.

    `x` and `y` are the coordinates of columns and rows on the detector; `distances` those of detector and main lens
    from the array, the main lens's focal length, and the distance of the object; `radius` is the pupil's.
    """
    z, b, f1, g = distances
    down, across = bins.shape
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            # The corner of four lenses lies on the axis.
            lens_x = (math.floor(x[c] * b / (b + z) / pitch) + 0.5) * pitch
            lens_y = (math.floor(y[r] * b / (b + z) / pitch) + 0.5) * pitch
            slope_x = (lens_x - x[c]) / z
            slope_y = (lens_y - y[r]) / z
            pupil_x = lens_x + b * slope_x
            pupil_y = lens_y + b * slope_y
            if pupil_x * pupil_x + pupil_y * pupil_y > radius * radius:
                continue
            i = math.floor(-b * (pupil_x / g + slope_x - pupil_x / f1) / pitch + across / 2)
            j = math.floor(-b * (pupil_y / g + slope_y - pupil_y / f1) / pitch + down / 2)
            if 0 <= i < across and 0 <= j < down:
                bins[j, i] += image[r, c]


def run_plain_sums(image: Array, camera: PlenopticCamera, distance: float) -> Array:
    """Return an image's sums by a plain loop, for an unfocused camera with square lenses."""
    bins = np.zeros(camera.bin_count[::-1])
    x, y = (camera.pixel_coordinates(axis) for axis in (0, 1))
    distances = camera.detector_distance, camera.mla_distance, camera.focal_length, distance
    plain_sums(image, x, y, distances, camera.row_pitch, pupil_radius(camera), bins)
    return bins
