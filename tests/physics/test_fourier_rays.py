"""Ray captures of microscopes in the Fourier arrangement against closed forms and Mitsuba's own sensors."""

import mitsuba as mi
import numpy as np
import pytest

import mitsuba_plenoptic as mp

PATH = {"type": "path", "max_depth": 2}


def microscope(aperture, immersion, **numbers):
    """Seven lenses across the stop, with micro-images that touch."""
    focal_length, z, pitch = 100.0, 10.0, 200 * aperture / (60 * 7)
    stop = pitch / 2 * focal_length / z
    lens = mp.Objective(
        60, aperture, immersion, arrangement="fourier", fourier_focal_length=focal_length, field_stop=stop
    )
    usual = {"mla_lattice": "hexagonal", "mla_focal_length": z, "detector_width": 7.5 * pitch, "resolution": (300, 300)}
    return mp.PlenopticCamera(main_lens=lens, mla_pitch=pitch, **(usual | numbers))


def rendered(camera, *shapes, spp=64):
    scene = {"type": "scene", "integrator": PATH, "sensor": camera.to_sensor()}
    return mi.render(mi.load_dict(scene | {f"shape{i}": shape for i, shape in enumerate(shapes)}), spp=spp).numpy()[
        ..., 0
    ]


def places(camera, point):
    """Mean place in pixels of a point in the image of each lit lens, over the lens's lit part."""
    lens, (X, Y, d) = camera.main_lens, point
    index, _ = mp.design.lenses_in_stop(camera)
    along = (np.arange(100) + 0.5) / 100
    aside = np.stack(camera.lattice.aperture_point(*np.meshgrid(along, along))).reshape(2, -1)
    result = []
    for centre in np.stack(camera.lattice.centre(*index.T), -1):
        m = centre[:, None] + aside
        m = m[:, np.hypot(*m) <= lens.blur_diameter(0) / 2]
        sines = m * lens.magnification / lens.last_focal_length / lens.immersion
        seen = np.array([[X], [Y]]) - d * sines / np.sqrt(1 - (sines**2).sum(0))
        p = (centre + lens.view_scale(camera.detector_distance) * seen.mean(1)) / camera.pixel_size
        result.append(p + np.array(camera.resolution) / 2)
    return np.array(result)


@pytest.mark.parametrize(("aperture", "immersion"), [(0.5, 1.0), (1.0, 1.33), (1.3, 1.515)])
@pytest.mark.parametrize("turned", [0.0, 20.0])
def test_beads_are_where_their_rays_lead(aperture, immersion, turned):
    camera = microscope(aperture, immersion, mla_rotation=turned, mla_offset=(0.01, -0.02))
    wide = camera.main_lens.field_stop / 60
    point = np.array([0.2, -0.15, 0.3 if aperture < 1 else 0.1]) * wide
    bead = {"type": "sphere", "center": point.tolist(), "radius": 0.03 * wide, "emitter": {"type": "area"}}
    image = rendered(camera, bead, spp=256)
    y, x = np.mgrid[:300, :300] + 0.5
    for place in places(camera, point):
        near = np.where(np.hypot(x - place[0], y - place[1]) < 9, image, 0)
        if place.min() > 10 and place.max() < 290 and near.sum() > 0.3 * np.pi * 0.36:
            found = np.array([(near * x).sum(), (near * y).sum()]) / near.sum()
            assert np.hypot(*(found - place)) < 0.2, place


def test_a_surface_is_that_of_an_orthographic_sensor_from_the_lens():
    """A lens of a hundredth of the stop sees in one direction; the mean over 25 of its pixels has little noise."""
    camera = microscope(0.5, 1.0)
    lens = camera.main_lens
    small = camera.replace(
        mla_fill=0.1, mla_aperture="circle", mla_lattice="square", mla_offset=(camera.mla_pitch / 2,) * 2
    )
    half = 1.5 * lens.field_stop / 60
    texels = np.random.default_rng(3).random((5, 5)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels[..., None]), "raw": True}
    place = mi.ScalarTransform4f().translate([0, 0, 0.02]).rotate([0, 1, 0], 165).scale(half)
    plane = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": texture}}
    image = rendered(small, plane, spp=256)
    # The lens two pitches beside the axis.
    sine = 2 * camera.mla_pitch * lens.magnification / lens.last_focal_length
    direction = np.array([sine, 0, np.sqrt(1 - sine**2)])
    pixel = camera.pixel_size / lens.view_scale(camera.detector_distance)
    scene = mi.load_dict({"type": "scene", "shape": plane})
    middle = np.array([2 * camera.mla_pitch / camera.pixel_size + 150, 150])
    for dx, dy in ((0, 0), (6, -4), (-7, 8)):
        column, row = np.rint(middle + np.array([dx, dy])).astype(int)
        spread = (np.arange(-2, 3) + 0.5)[:, None] + np.zeros(5)
        x = (column - middle[0] + spread.T) * pixel
        y = (row - middle[1] + spread) * pixel
        origin = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()]) - direction[:, None]
        rays = mi.Ray3f(mi.Point3f(origin.astype(np.float32)), mi.Vector3f(*direction.tolist()))
        seen = scene.ray_intersect(rays)
        expected = seen.emitter(scene).eval(seen).numpy()[0].mean()
        found = image[row - 2 : row + 3, column - 2 : column + 3].mean()
        assert found == pytest.approx(expected, rel=0.01), (dx, dy)


def test_micro_images_end_at_the_field_stop():
    for shape, area in (("disc", np.pi / 4), ("square", 1.0)):
        lens = mp.Objective(
            20, 0.5, arrangement="fourier", fourier_focal_length=24.4, field_stop=0.25, field_stop_shape=shape
        )
        camera = mp.PlenopticCamera(
            main_lens=lens, mla_pitch=0.5, mla_focal_length=20.0, mla_aperture="circle", mla_fill=0.6,
            detector_width=1.0, resolution=(200, 200),
        )  # fmt: skip
        image = rendered(camera, {"type": "constant", "radiance": 1.0}, spp=16)
        # Four images, each of 0.5 * 20 / 24.4 mm across.
        assert image.sum() == pytest.approx(4 * area * (0.5 * 20 / 24.4 / 0.005) ** 2, rel=0.005)
        assert image.max() == pytest.approx(1) and image.min() == 0


def test_a_lamp_is_seen_by_lenses_four_pitches_away():
    """Without a field stop all lenses of the stop's image light a pixel, not only those around it."""
    lens = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=100)
    camera = mp.PlenopticCamera(
        main_lens=lens, mla_pitch=0.5, mla_focal_length=20.0, detector_width=5.0, resolution=(100, 100)
    )
    # The lamp's image is z M X / f = 2 mm beside the centre of each lens.
    lamp = {"type": "sphere", "center": [0.5, 0.0, 0.0], "radius": 0.012, "emitter": {"type": "area"}}
    image = rendered(camera, lamp, spp=1024)
    index, open_part = mp.design.lenses_in_stop(camera)
    x, y = np.stack(camera.lattice.centre(*index.T))
    place = np.stack([x + 2.0, y])[:, (x < 0.4) & (open_part == 1)]
    column, row = np.floor(place / camera.pixel_size + 50).astype(int)
    around = [image[r - 1 : r + 2, c - 1 : c + 3].sum() for r, c in zip(row, column, strict=True)]
    assert len(around) > 20 and min(around) > 0
    # Of lenses that the edge of the stop's image cuts, and nothing else.
    assert 0.6 < sum(around) / image.sum() < 1
