"""Ray refocusing against a slow direct sum, geometry and closed forms."""

import math

import numpy as np
import pytest

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Capture, PlenopticCamera, reconstruct
from mitsuba_plenoptic.refocus.methods import METHODS, method
from mitsuba_plenoptic.refocus.projection import ray_sums
from mitsuba_plenoptic.views import white_image


def by_single_rays(image, camera, distance):
    """Refocus with the textbook's loop: each pixel's ray, written out, into a histogram."""
    b, z, f1, pitch = camera.mla_distance, camera.detector_distance, camera.focal_length, camera.mla_pitch
    rows, columns = np.indices(image.shape)
    px = (columns + camera.crop_offset[0] + 0.5 - camera.resolution[0] / 2) * camera.pixel_size
    py = (rows + camera.crop_offset[1] + 0.5 - camera.resolution[1] / 2) * camera.pixel_size
    cx, cy = ((np.floor(p * b / (b + z) / pitch) + 0.5) * pitch for p in (px, py))
    tx, ty = (cx - px) / z, (cy - py) / z
    Px, Py = cx + b * tx, cy + b * ty
    X, Y = Px + distance * (tx - Px / f1), Py + distance * (ty - Py / f1)
    size = pitch * distance / b
    # Half a pixel more than the pupil, so that pixels lit in part count.
    inside = np.hypot(Px, Py) <= camera.aperture_radius + camera.pixel_size / 2 * b / z
    nx, ny = camera.lens_count
    edges = [(np.arange(n + 1) - n / 2) * size for n in (ny, nx)]
    total, _, _ = np.histogram2d(-Y[inside], -X[inside], bins=edges, weights=image[inside])
    return total


@pytest.mark.parametrize("distance", [210.0, 283.0])
@pytest.mark.parametrize(
    "camera",
    [
        PlenopticCamera(detector_width=1.024, resolution=(512, 512)),
        PlenopticCamera(detector_width=1.024, resolution=(500, 300), crop_offset=(33, 7), crop_size=(420, 260)),
        PlenopticCamera(detector_width=1.1, resolution=(512, 512), mla_focal_length=0.6, aperture_radius=7),
    ],
    ids=["paper", "crop", "other"],
)
def test_point_version_is_the_direct_sum(camera, distance):
    image = np.random.default_rng(0).random(camera.shape)
    ours = reconstruct(image, distance, camera=camera, footprint="point").image
    light, white = (by_single_rays(pixels, camera, distance) for pixels in (image, white_image(camera)))
    dark = white < 0.01 * white.max()
    assert np.array_equal(np.isnan(ours), dark)
    # A pixel whose ray meets a bin's edge to within rounding may go to either side.
    theirs = light[~dark] / white[~dark]
    assert np.abs(ours[~dark] - theirs).sum() <= 2e-3 * theirs.sum()


def test_footprint_version_is_the_mean_of_rays_through_the_whole_lens():
    camera = PlenopticCamera(detector_width=0.512, resolution=(256, 256))
    image = np.zeros(camera.shape)
    image[150, 140] = 1.0
    ours = ray_sums(image[..., None], camera, 280.0, camera.lit_radius, "lens", 1)[..., 0]
    # Many rays through the lens of this one pixel.
    b, z, f1 = camera.mla_distance, camera.detector_distance, camera.focal_length
    p = (np.array([140, 150]) + 0.5 - 128) * camera.pixel_size
    m = (np.floor(p * b / (b + z) / 0.064)[:, None] + (np.arange(2000) + 0.5) / 2000) * 0.064
    c = (np.floor(p * b / (b + z) / 0.064)[:, None] + 0.5) * 0.064
    t = (m - p[:, None]) / z - (m - c) / camera.mla_focal_length
    P = m + b * t
    u = -(P + 280 * (t - P / f1)) * b / 280 / 0.064 + 4
    x, y = (np.histogram(axis, bins=np.arange(9))[0] / 2000 for axis in u)
    expected = np.outer(y, x)
    np.testing.assert_allclose(ours, expected, atol=2e-3 * expected.max())
    assert np.count_nonzero(expected) >= 2


def ramp_capture(camera, distance):
    """What the camera records of a radiance that rises from 0.5 to 1.5 across the field: what each pixel sees there."""
    p = camera.pixel_coordinates(0)
    c, _ = camera.lattice.centre(*camera.lattice.cell(*np.meshgrid(*(camera.pixel_coordinates(i) for i in (0, 1)))))
    t = (c - p) / camera.detector_distance
    P = c + camera.mla_distance * t
    slope = t - P / camera.focal_length + P / distance
    return white_image(camera) * (1 - 0.5 * slope / (camera.bin_count[0] * camera.mla_pitch / 2 / camera.mla_distance))


@pytest.mark.parametrize("distance", [150.0, 240.0, math.inf])
@pytest.mark.filterwarnings("ignore:distance = ")
@pytest.mark.parametrize("lattice", [{}, {"mla_lattice": "hexagonal"}], ids=["square", "hexagonal"])
def test_walls_are_right_to_the_border(lattice, distance):
    camera = PlenopticCamera(detector_width=1.024, resolution=(512, 512), **lattice)
    columns = (np.arange(16) + 0.5) / 8 - 1
    white = reconstruct(white_image(camera), distance, camera=camera)
    np.testing.assert_allclose(white.image, 1, atol=1e-5)
    # X / g grows to the left.
    ramp = reconstruct(ramp_capture(camera, distance), distance, camera=camera)
    np.testing.assert_allclose(ramp.image, np.tile(1 + 0.5 * columns, (16, 1)), atol=0.03)
    assert white.bin_size == pytest.approx(0.064 / 120 * (1 if math.isinf(distance) else distance))


@pytest.mark.parametrize("wavelength", [None, pytest.param((633.0, 550.0, 550.0), marks=pytest.mark.slow)])
def test_distances_outside_the_range_of_refocusing_are_told(wavelength):
    """Samples per lens fall with the distance from the plane in focus, in diopters, over that of the range's end."""
    camera = PlenopticCamera(detector_width=0.128, resolution=(32, 32))
    image = np.ones((*camera.shape, 3) if isinstance(wavelength, tuple) else camera.shape)
    capture = Capture(image, camera, wavelength, "ray" if wavelength is None else "wave")
    longest = None if wavelength is None else np.max(wavelength)
    near, far = mp.design.refocus_range(camera, longest)
    distances = [1.01 * near, 240.0, 0.99 * far, 1.01 * far, 5000.0, math.inf]
    at = "" if wavelength is None else " at 633 nm"
    with pytest.warns(UserWarning, match=f"far outside the range of refocusing{at}, {near:.4g} to {far:.4g}") as told:
        facts = [result.facts for result in reconstruct(capture, distances)]
    assert [str(warning.message).partition(":")[0] for warning in told] == ["distance = 5000, inf"]
    assert [fact["in_range"] for fact in facts] == [True] * 3 + [False] * 3
    outside = [(1 / 240 - 1 / far) / (1 / 240 - 1 / distance) for distance in distances[4:]]
    assert [fact["samples_per_lens"] for fact in facts[4:]] == pytest.approx(outside, rel=1e-3)
    # The range is the same quantity where lenses are sharp in a part of it.
    focused = Capture(image, camera.replace(detector_distance=0.4), wavelength, capture.model)
    ends = [(1 + step) * end for end in mp.design.refocus_range(focused.camera, longest) for step in (-1e-3, 1e-3)]
    assert [result.facts["in_range"] for result in reconstruct(focused, ends)] == [False, True, True, False]


def test_a_new_method_is_one_registered_function(monkeypatch):
    monkeypatch.setitem(METHODS, "mean", None)

    @method("mean", options=("footprint",), waves=False)
    def mean(task, *, footprint):
        return [np.full((*task.camera.bin_count[::-1], 1), task.image.mean() + g) for g in task.distances]

    camera = PlenopticCamera(detector_width=0.128, resolution=(64, 64))
    result = reconstruct(np.ones((64, 64)), 240.0, camera=camera, method="mean", footprint="point")
    assert (result.image == 241).all() and result.image.shape == (2, 2)
    assert result.options == {"footprint": "point", "oversample": 1}
