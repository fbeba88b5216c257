"""Volumes projected on an array, against captures of points through the whole camera, and fits of such volumes."""

import numpy as np
import pytest
from refusals import refuses
from test_compare_real import CAMERA as OBJECTIVE
from test_compare_real import THIN

from mitsuba_plenoptic import CaptureOperator
from mitsuba_plenoptic.extensions.calibrate.array_fit import fit_array
from mitsuba_plenoptic.extensions.calibrate.field_fit import FieldNumbers
from mitsuba_plenoptic.extensions.calibrate.micro_image import PupilNumbers
from mitsuba_plenoptic.extensions.prediction.array_part import ArrayPart, CameraModel, PartPixels
from mitsuba_plenoptic.extensions.prediction.point_patterns import plane_of
from mitsuba_plenoptic.extensions.prediction.projector import SceneProjection
from mitsuba_plenoptic.extensions.prediction.scene_fit import fit_scene
from mitsuba_plenoptic.extensions.prediction.withheld import Ratio, Withheld, by_lens, misfit

CAMERA = OBJECTIVE.replace(
    mla_rotation=0.3, mla_offset=(0.0625,) * 2, detector_width=1.875, resolution=(180, 180), detector_blur=0.007
)
"""Fifteen lenses of twelve pixels along a side, turned."""


def model_of(camera, wavelength=550.0):
    """The model of a camera that is known, with a round and even pupil."""
    row, column = (steps.ravel() for steps in np.mgrid[-8:7, -8.0:7])
    aside = 0.0 if camera.lattice.rectangular else 0.5
    index = np.column_stack([column + aside * (row % 2), row])
    centre = np.stack(camera.lattice.centre(index[:, 0] - aside * row, row), axis=-1)
    place = centre * camera.image_growth / camera.pixel_size + (np.array(camera.resolution) - 1) / 2
    pupil = PupilNumbers(camera.pupil_radius / camera.pupil_step, blur=camera.detector_blur / camera.pixel_size)
    field = FieldNumbers(camera.resolution, 0, pupil)
    return CameraModel(camera, wavelength, fit_array(place, index, camera), field, index, np.ones(len(index)))


def part_of(model):
    """The part of eleven lenses along a side."""
    return ArrayPart(model, PartPixels.of(model, (20, 20, 160, 160)))


MODEL = model_of(CAMERA)
PART = part_of(MODEL)
HEXAGONAL = THIN.replace(mla_lattice="hexagonal")


@pytest.fixture(scope="module")
def projector():
    return SceneProjection(PART, [plane_of(PART, depth) for depth in (0.0, -0.03)])


@pytest.mark.parametrize(
    ("camera", "distance"), [pytest.param(CAMERA, 0.012, marks=pytest.mark.slow), (HEXAGONAL, 380.0)]
)
def test_elements_are_recorded_as_their_points_are(camera, distance):
    """Fine points of one element of a lens near the middle, through the whole turned camera."""
    part = part_of(model_of(camera))
    projector = SceneProjection(part, [plane_of(part, distance)])
    across = projector.planes[0].across
    lens = len(part.place) // 2
    row, column = np.divmod(lens, part.lenses[0])
    scene = np.zeros(projector.source_shape, np.float32)
    scene[row + projector.reach, column + projector.reach, across + 2] = 1
    angle = np.deg2rad(camera.mla_rotation)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = (part.place[lens] - (np.array(camera.resolution) - 1) / 2) * camera.pixel_size / camera.image_growth
    step = (np.arange(4) + 0.5) / 4
    at = np.stack(np.meshgrid((2 + step) / across - 0.5, (1 + step) / across - 0.5), -1).reshape(-1, 2)
    at = at * [camera.mla_pitch, camera.lattice.row_distance] @ turn.T
    points = -(centre + at) * camera.bin_size(distance) / camera.mla_pitch
    operator = CaptureOperator(camera, np.column_stack([points, np.full(16, distance)]), wavelength=550.0, accuracy=0)
    exact = operator.forward(np.full(16, 1 / 16)).ravel()[part.pixel]
    # Pixels of the regular array are smaller.
    found = projector.direct(scene) * part.along * part.down / part.model.pitch.prod()
    # The white picture, by which pixels are weighted, has an even pupil; points radiate evenly over angles.
    assert np.linalg.norm(found - exact) < 0.04 * np.linalg.norm(exact)
    assert found.sum() == pytest.approx(exact.sum(), rel=0.03)


def test_pictures_with_sharp_borders_are_weighted_evenly():
    """Without a blur rays of an even volume end within a pixel, beyond which nothing may be amplified."""
    part = part_of(model_of(CAMERA.replace(detector_blur=0.0), None))
    projector = SceneProjection(part, [plane_of(part, 0.0), plane_of(part, 0.012)])
    even = projector.direct(np.ones(projector.source_shape, np.float32))
    white = part.white * (even.sum() / part.white.sum())
    assert np.abs(even - white).max() < 0.15 * white.max()
    assert np.linalg.norm(even - white) < 0.03 * np.linalg.norm(white)


def test_each_lens_is_white_by_its_pupil():
    """Radii that fall to 0.4 of the middle's within seven lenses: the light is the area of the pupil's image."""
    model = model_of(CAMERA.replace(detector_blur=0.0), None)
    radius = model.field.coefficients["radius"][0]
    # 1; X, Y; X^2, X Y, Y^2 of places over half the picture.
    model.field.coefficients["radius"] = radius * np.array([1.0, 0, 0, -0.7, 0, -0.7])
    part = part_of(model)
    area = np.pi * model.field.values(part.place)[:, 0] ** 2
    assert area.min() < 0.2 * area.max()
    np.testing.assert_allclose(np.bincount(part.lens_of, part.white), area, rtol=0.03)


def test_the_adjoint_is_the_transpose(projector):
    generator = np.random.default_rng(0)
    volume, pixels = (generator.random(n, np.float32) for n in (projector.source_shape, projector.image_shape))
    back = np.vdot(volume, projector.adjoint(pixels))
    assert np.vdot(projector.forward(volume), pixels) == pytest.approx(back, rel=1e-5)
    assert (projector.forward(volume)[0] == projector.direct(volume)).all()
    assert (projector.join(projector.split(volume)) == volume).all()


def test_rays_of_a_point_spread_over_lenses_as_the_cone_does():
    """Of a source even within alpha, tan^2 has the mean (1 / cos(alpha) + cos(alpha) - 2) / (1 - cos(alpha))."""
    depth = -0.05
    plane = plane_of(part_of(model_of(CAMERA, None)), depth)
    lenses = plane.pictures.shape[0] // 12
    light = plane.pictures.sum(2).reshape(lenses, 12, lenses, 12).sum((1, 3)) / plane.across**2
    place = (np.arange(lenses) - lenses // 2) * 0.125
    cosine = np.cos(CAMERA.objective.half_angle)
    tangents = (1 / cosine + cosine - 2) / (1 - cosine)
    found = (light * (place**2 + place[:, None] ** 2)).sum()
    # Voxels and lenses are squares of one pitch.
    assert light.sum() == pytest.approx(1, abs=1e-3)
    assert found == pytest.approx((20 * depth) ** 2 * tangents + 2 * 2 * 0.125**2 / 12, rel=0.02)


def test_withheld_pixels_of_a_simulated_volume_are_predicted(projector):
    """A volume with structure, noise of photons: the residual of pixels that the fit has not seen is that of noise."""
    generator = np.random.default_rng(1)
    expected = projector.direct((generator.random(projector.source_shape) ** 8).astype(np.float32))
    electrons = generator.poisson(expected * (400 / expected.mean())).astype(np.float32)
    withheld = Withheld.drawn(PART.pixels, np.ones(len(PART.pixel), bool), 0)
    fit = fit_scene(projector, electrons, withheld.used, dark_variance=1.0, strength=1e-3, iterations=60)
    over_noise = misfit(electrons, fit.predicted, 1.0)
    tested = withheld.tested["pixels"]
    assert fit.stray < 0.02
    assert over_noise[tested].mean() < 1.5
    # An even volume predicts far worse, and lenses that are not seen at all worse than pixels.
    even = electrons[withheld.used].mean() * PART.white / PART.white[withheld.used].mean()
    assert misfit(electrons, even, 1.0)[tested].mean() > 10
    sums = by_lens(over_noise, withheld.tested["lenses"], PART.pixels)
    assert 1.5 < sums[0].sum() / sums[1].sum() < 50


def test_verdicts_can_come_out_either_way():
    generator = np.random.default_rng(0)
    small, large = (np.stack([generator.chisquare(100, 400) * factor, np.full(400, 100)]) for factor in (1.0, 1.3))
    assert Ratio.of(large, small).better == "rays"
    assert Ratio.of(small, small[:, ::-1]).better == "neither"
    found = Ratio.of(small, large)
    assert found.better == "waves"
    assert found.low < found.ratio < found.high
    assert found.ratio == pytest.approx(np.sqrt(1.3), rel=0.02)
    # Pixels are withheld in three lenses alone.
    found = Ratio.of(*(some * (np.arange(400) < 3) for some in (small, large)))
    assert 1 < found.low <= found.high < 1.5


def test_small_parts_are_refused():
    few = PartPixels.of(MODEL, (20, 20, 120, 160))
    refuses("part: 28 of its lenses", Withheld.drawn, few, few.pixel > 0, 0)
