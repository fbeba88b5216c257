"""Light fields of Fourier microscopes: places, parallax, brightness and depth of views against closed forms."""

import math

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import (
    Capture,
    CaptureOperator,
    Objective,
    PlenopticCamera,
    decode,
    point_spread_function,
    reconstruct,
    render_capture,
)  # fmt: skip
from mitsuba_plenoptic.design import lenses_across_stop, parallax
from mitsuba_plenoptic.refocus import read_reconstruction, write_reconstruction
from mitsuba_plenoptic.views import (
    camera_of,
    depth_map,
    disparity,
    distance_of,
    focal_stack,
    refocus,
    view,
    white_image,
)  # fmt: skip

LENS = Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50)
ARRAY = {"mla_pitch": 0.5, "mla_focal_length": 20.0, "mla_offset": (0.25, 0.25)}
SQUARE = PlenopticCamera(main_lens=LENS, **ARRAY, detector_width=2.6, resolution=(260, 260))
HEXAGONAL = SQUARE.replace(mla_lattice="hexagonal", mla_offset=(0, 0))
TO_STOP = -200 / 50
POINTS = np.array([[0.01, -0.004, 0.02]])


def capture_of(camera, points=POINTS, power=1.0):
    image = CaptureOperator(camera, points, wavelength=550, method="full_field").forward(np.full(len(points), power))
    return Capture(np.maximum(image, 0), camera, 550.0, "wave", {})


@pytest.fixture(scope="module")
def square():
    return capture_of(SQUARE)


@pytest.fixture(scope="module")
def hexagonal():
    return capture_of(HEXAGONAL)


@pytest.fixture(scope="module", params=["square", "hexagonal"])
def lf(request):
    return decode(request.getfixturevalue(request.param))


def test_each_view_sees_the_object_from_its_lenss_direction(lf):
    """The centre of light of each view that is not cut by the stop, against the parallax of its lens."""
    camera, (X, Y, depth) = camera_of(lf), POINTS[0]
    scale = LENS.view_scale(camera.detector_distance)
    lit = np.argwhere(lf.weight.values[:, :, lf.sizes["t"] // 2, 24] > 0.9)
    assert len(lit) >= 13
    for row, column in lit:
        picture = lf.isel(v=row, u=column)
        values = np.where(picture.values > 0.05 * float(picture.max()), picture.values, 0)
        x, y = (float((values * axis).sum() / values.sum()) for axis in (picture.s.values, picture.t.values[:, None]))
        c = np.array([float(lf.u[column]), float(lf.v[row])]) / TO_STOP
        distance = float(np.hypot(*c))
        shift = parallax(camera, distance) * depth / scale * (c / distance) if distance else np.zeros(2)
        assert np.allclose([x, y], [X + shift[0], Y + shift[1]], atol=0.35 * camera.bin_size(0))


def test_even_lenses_have_even_views(lf):
    """Pictures are divided by what a lens sees of the stop; a point that radiates evenly is 1 / cos(theta) brighter."""
    whole = lf.weight.values.max(axis=(2, 3)) > 0.9
    sums = lf.sum(("s", "t")).values[whole] * np.cos(np.arctan(np.hypot(lf.slope_x, lf.slope_y).values[whole]))
    assert np.ptp(sums) < 0.03 * sums.mean()
    # All of a pixel's lens is lit by a bin of radiance r with what radiance_weight says of it.
    lenses = math.pi * (LENS.blur_diameter(0) / 2) ** 2 / camera_of(lf).lattice.lens_area
    mean = 2 * (1 - math.sqrt(0.75)) / 0.25
    assert sums.mean() == pytest.approx(1 / lenses / mean, rel=0.03)


def test_a_hexagonal_array_leaves_places_without_a_view(hexagonal):
    lf = decode(hexagonal)
    there = lf.weight.values.max(axis=(2, 3)) > 0
    assert view(lf, u=float(lf.u[1]), v=float(lf.v[2])).values.any() and view(lf, u=1.0, v=0.0).values.any()
    assert not (there[:, :-1] & there[:, 1:]).any()
    assert np.allclose(np.diff(lf.u), 0.25 * TO_STOP)
    assert np.allclose(np.diff(lf.v), 0.25 * math.sqrt(3) * TO_STOP)
    assert not lf.values[~there].any()


def test_views_are_upright_and_crops_lose_their_pixels(square):
    whole = decode(square)
    part = decode(capture_of(SQUARE.replace(crop_offset=(70, 90), crop_size=(120, 100))))
    assert (np.diff(whole.s) < 0).all() and (np.diff(whole.u) < 0).all()
    assert part.shape == whole.shape
    seen = part.weight.values > 0.9
    assert 0.1 < seen.mean() < 0.5
    assert np.abs(part.values - whole.values)[seen].max() < 1e-3 * float(whole.max())


def test_a_white_capture_and_colours(square):
    white = np.full(SQUARE.shape, 0.5, np.float32)
    colour = decode(np.repeat(square.image[..., None], 3, axis=2), camera=SQUARE, white=white)
    np.testing.assert_allclose(decode(square, white=6 * white).values, colour.values[..., 0], rtol=1e-5)
    plain = decode(square)
    assert colour.dims == ("v", "u", "t", "s", "c")
    lit = plain.weight.values > 0.9
    # This white knows no stop; its radiance is found by the computed one near the axis.
    expected = plain.values * plain.white.values
    assert np.allclose(colour.values[..., 0][lit], expected[lit], atol=1e-3 * float(plain.max()))


ALONE = {"mla_pitch": 0.5, "mla_focal_length": 6.0, "detector_width": 3.0, "resolution": (240, 240)}


def microscope(aperture=0.5, magnification=20, immersion=1.0, stop=2.08, **changes):
    """Return a microscope whose field stop ends micro-images of 40 pixels where they would overlap."""
    lens = Objective(
        magnification, aperture, immersion, arrangement="fourier", fourier_focal_length=50, field_stop=stop
    )
    return PlenopticCamera(main_lens=lens, **ALONE | changes)


BY_RAYS = {
    "square": microscope(),
    "turned": microscope(mla_rotation=12.0, mla_offset=(0.2, -0.11)),
    "hexagonal": microscope(mla_lattice="hexagonal", mla_rotation=33.0, mla_offset=(0.1, 0.05)),
    "out of focus": microscope(mla_focal_length=6.2, mla_offset=(0.1, 0.2), stop=1.7, detector_distance=6.0),
}
by_rays = pytest.mark.parametrize("camera", BY_RAYS.values(), ids=BY_RAYS)


def rendered(camera, shape=None, depth=0.0, place=(0.0, 0.0), size=1.0, radiance=1.0, spp=64, **model):
    """Return a capture, by rays unless told, of a surface that faces the objective, by default of even light."""
    turned = mi.ScalarTransform4f().translate([*place, depth]).rotate([0, 1, 0], 180).scale(size)
    surface = {"type": shape, "to_world": turned, "emitter": {"type": "area", "radiance": radiance}}
    light = {"type": "constant", "radiance": 1.0} if shape is None else surface
    scene = {"type": "scene", "sensor": camera.to_sensor(), "integrator": {"type": "path"}, "light": light}
    return render_capture(mi.load_dict(scene), spp=spp, **model or {"model": "ray"})


@by_rays
def test_directions_are_means_over_the_lit_part_of_each_lens(camera):
    """Against points of the stop, of which each belongs to the lens whose cell holds it."""
    lf = decode(np.ones(camera.shape, np.float32), camera=camera)
    m = np.stack(np.meshgrid(*2 * [(np.arange(600) + 0.5) / 240 - 1.25])).reshape(2, -1)
    m = m[:, np.hypot(*m) < 1.25]
    i, j = camera.lattice.cell(*m)
    tangent = np.tan(np.arcsin(np.hypot(*m) * 20 / 50)) * m / np.hypot(*m)
    turn = math.radians(camera.mla_rotation - 90 * round(camera.mla_rotation / 90))
    axes = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    seen = lf.weight.values.max(axis=(2, 3))
    compared = 0
    for number in np.unique(100 * i + j):
        of_lens = 100 * i + j == number
        lit = of_lens.sum() / 240**2 / float(camera.lattice.cell_area)
        if lit < 0.11:
            continue
        u, v = TO_STOP * axes @ camera.lattice.centre(i[of_lens][0], j[of_lens][0])
        place = int(np.argmin(abs(lf.v.values - v))), int(np.argmin(abs(lf.u.values - u)))
        assert math.isclose(seen[place], lit, abs_tol=0.006)
        slope = float(lf.slope_x[place]), float(lf.slope_y[place])
        assert np.allclose(slope, tangent[:, of_lens].mean(axis=1), atol=0.001)
        compared += 1
    assert np.count_nonzero(seen) - 1 <= compared >= 20


@by_rays
def test_an_even_scene_reads_one(camera):
    capture = rendered(camera, spp=256)
    assert white_image(camera).sum() == pytest.approx(capture.image.sum(), rel=0.01)
    lf = decode(capture)
    values = lf.values[lf.weight.values > 0.5]
    assert values.mean() == pytest.approx(1, abs=0.004)
    for image in (refocus(lf, 0.03).values, reconstruct(capture, 0.03).image):
        row, column = (np.arange(size) - (size - 1) / 2 for size in image.shape)
        middle = image[np.hypot(row[:, None], column) < 14]
        assert np.abs(middle - 1).max() < 0.05
        assert middle.mean() == pytest.approx(1, abs=0.004)


@pytest.mark.parametrize("changes", [{"mla_absorption": 0.05}, {"pixel_response": (0, 1, 5, 0.4)}])
@pytest.mark.parametrize("model", ["ray", pytest.param("wave", marks=pytest.mark.slow)])
def test_an_even_scene_reads_one_whatever_pixels_and_medium_take(changes, model):
    """By waves, what diffraction takes is divided out, too."""
    camera = microscope(**changes)
    capture = rendered(camera, model=model, **({"wavelength": 550.0} if model == "wave" else {}))
    lf = decode(capture)
    assert np.median(capture.image[capture.image > 0.5]) < 0.9
    assert lf.values[lf.weight.values > 0.5].mean() == pytest.approx(1, abs=0.006)


@by_rays
@pytest.mark.parametrize("depth", [-0.05, 0.03])
def test_a_disc_is_refocused_at_its_place_as_bright_as_it_is(camera, depth, tmp_path):
    place, radius = np.array([0.0147, -0.0103]), 0.02
    capture = rendered(camera, "disk", depth, place, radius, spp=256)
    lf = decode(capture)
    image = focal_stack(lf, [depth])[0]
    fine = reconstruct(capture, depth, oversample=2)
    write_reconstruction(tmp_path / "plane.exr", fine)
    assert read_reconstruction(tmp_path / "plane.exr").distance == depth
    axis = ((fine.image.shape[0] - 1) / 2 - np.arange(fine.image.shape[0])) * fine.bin_size
    for values, s, t in ((image.values, lf.s.values, lf.t.values), (np.nan_to_num(fine.image), axis, axis)):
        area = (s[0] - s[1]) * (t[0] - t[1])
        assert values.sum() * area == pytest.approx(math.pi * radius**2, rel=0.02)
        middle = np.hypot(s - place[0], t[:, None] - place[1]) < 0.3 * radius
        assert values[middle].mean() == pytest.approx(1, abs=0.06)
        lit = np.where(values > 0.1, values, 0)
        found = (lit * s).sum() / lit.sum(), (lit * t[:, None]).sum() / lit.sum()
        assert np.allclose(found, place, atol=0.1 * camera.bin_size(0))


OBJECTIVES = {
    "dry": microscope(),
    "turned": microscope(mla_rotation=12.0, mla_offset=(0.2, -0.11)),
    "hexagonal": microscope(mla_lattice="hexagonal", mla_rotation=33.0, mla_offset=(0.1, 0.05)),
    "water": microscope(1.0, 40, 1.33, mla_focal_length=2.5, stop=5.0),
    "oil": microscope(1.3, 52, 1.515, mla_focal_length=1.9, stop=6.5),
}
DEPTHS = [("dry", -0.06), ("dry", 0.0), ("turned", 0.06), ("hexagonal", -0.02), ("water", 0.02), ("oil", -0.02)]


@pytest.mark.parametrize(("name", "depth"), DEPTHS)
def test_depth_of_a_textured_plane(name, depth):
    """Within a tenth of the depth that moves the outermost lens's picture by a pixel, or 1 %."""
    camera = OBJECTIVES[name]
    noise = np.fft.rfft2(np.random.default_rng(3).standard_normal((256, 256)))
    falloff = np.exp(-0.5 * (2 * math.pi * 5.5 * np.hypot(np.fft.rfftfreq(256), np.fft.fftfreq(256)[:, None])) ** 2)
    texture = np.fft.irfft2(noise * falloff)
    texture = np.clip(0.5 + 0.18 * texture / texture.std(), 0, 1).astype(np.float32)[..., None]
    pattern = {"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True}
    lf = decode(rendered(camera, "rectangle", depth, (0, 0), 50 * camera.bin_size(0), pattern, spp=32))
    depths = depth_map(lf, depth - 0.034, depth + 0.026, planes=32)
    middle = depths.isel(s=slice(10, -10), t=slice(10, -10))
    assert middle.depth.notnull().mean() > 0.6
    step = camera.bin_size(0) / np.hypot(lf.slope_x, lf.slope_y).values.max()
    assert float(middle.depth.median()) == pytest.approx(depth, abs=max(0.1 * step, 0.01 * abs(depth)))


def test_disparities_are_those_of_small_angles():
    lf = decode(np.ones(BY_RAYS["turned"].shape, np.float32), camera=BY_RAYS["turned"])
    # A lens one pitch aside sees from M D2 / f_F = 0.2; a pixel is f_F p / z M = 0.0125 x 50 / 120 in the object.
    assert disparity(lf, -0.02) == pytest.approx(-0.02 * 0.2 / (0.0125 * 50 / 120))
    assert distance_of(lf, disparity(lf, 0.03)) == pytest.approx(0.03)
    assert view(lf).values.max() > 0


def test_spreads_by_rays_light_all_of_the_stop_behind_a_narrow_field_stop():
    camera = microscope(stop=0.6)
    spread = point_spread_function(camera, (0.004, 0.0, 0.01), model="ray")
    lenses = lenses_across_stop(camera) ** 2 * math.pi / 4
    lit = (spread.reshape(6, 40, 6, 40).sum((1, 3)) > 0.02 * spread.sum()).sum()
    assert lit > 0.8 * lenses
