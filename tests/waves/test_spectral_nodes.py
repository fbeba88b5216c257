"""Spectra of captures by signed rays: against exact sums of points, rays, lines by themselves, and one another."""

import math
import pickle

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import error
from cases import facing, line, radiating, scene_of, sensor

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, Spectrum, render_capture
from mitsuba_plenoptic.optics import colour
from mitsuba_plenoptic.waves.signed_capture import SignedCapture
from mitsuba_plenoptic.waves.spectral_nodes import WavelengthSampler, node_spectra, span

CROWN = '{"index": 1.5168, "abbe": 64.2}'
GLASS = {"glass": CROWN, "mla_glass": CROWN}
SMALL = PlenopticCamera(resolution=(64, 64), detector_width=0.128)
PATCH = 0.03
"""Half the width of a small patch of light."""


def by_waves(scene, spp=16, **options):
    return render_capture(scene, model="wave", method="signed_rays", spp=spp, **options)


def coloured(lenses=6, **parameters):
    camera = sensor(lenses, 16, **parameters)
    camera["film"]["pixel_format"] = "rgb"
    return camera


def wall(radiance, **parameters):
    """Return the scene of a wall of one spectrum, before a film of colours."""
    emitter = {"type": "area", "radiance": radiance}
    black = {"type": "diffuse", "reflectance": 0.0}
    return scene_of(coloured(**parameters), wall=facing(240.0, 60.0, emitter=emitter, bsdf=black))


def seen(wavelengths, values):
    """Return what linear sRGB reads of a spectrum, by the integral over Mitsuba's tables of CIE 1931."""
    places = np.arange(380, 730, 0.02)
    return np.trapezoid(colour.srgb_responses(places) * np.interp(places, wavelengths, values), places, axis=1)


@pytest.mark.slow
def test_a_narrow_line_has_its_colour_and_energy():
    mi.set_variant("llvm_ad_spectral")
    wavelengths, values, radiance = line(532, 2)
    scene = wall(radiance)
    expected = seen(wavelengths, values) * by_waves(scene, wavelength=532.0).image.mean()
    capture = by_waves(scene, nodes=2)
    assert capture.image.mean((0, 1)) == pytest.approx(expected, abs=0.02 * float(expected[1]))
    assert capture.wavelength[0] > capture.wavelength[1] > capture.wavelength[2]


@pytest.mark.slow
def test_a_table_of_a_detector_takes_a_narrow_line(tmp_path):
    mi.set_variant("llvm_ad_spectral")
    table = tmp_path / "sensor.csv"
    table.write_text("wavelength,a,b,c\n450,0,1,0.2\n530,1,0,0.2\n600,0.5,1,0.2\n")
    wavelengths, values, radiance = line(532, 2)
    scene = wall(radiance)
    rows = np.array([(0, 1, 0.2), (1, 0, 0.2), (0.5, 1, 0.2)])
    columns = [np.interp(532, (450, 530, 600), row) / np.trapezoid(row, (450, 530, 600)) for row in rows.T]
    one = by_waves(scene, wavelength=532.0).image.mean()
    found = by_waves(scene, responses=str(table), nodes=2, spp=32).image.mean((0, 1))
    assert found == pytest.approx(np.array(columns) * np.trapezoid(values, wavelengths) * one, rel=0.03)


@pytest.mark.slow
def test_spectra_of_a_wall_agree_with_rays_and_with_colours():
    paint = {"type": "rgb", "value": [0.8, 0.4, 0.1]}
    means, options = {}, {"responses": "srgb", "nodes": 2}
    for variant in ("llvm_ad_rgb", "llvm_ad_spectral"):
        mi.set_variant(variant)
        light = {"type": "constant", "radiance": {"type": "d65"} if "spectral" in variant else 1.0}
        board = facing(240.0, 60.0, bsdf={"type": "diffuse", "reflectance": paint})
        scene = scene_of(coloured(), "direct", board=board, light=light)
        means[variant] = by_waves(scene, **options).image.mean((0, 1))
        rays = render_capture(scene, model="ray", spp=64).image.mean((0, 1))
        assert means[variant] == pytest.approx(rays, rel=0.02)
    assert means["llvm_ad_rgb"] == pytest.approx(means["llvm_ad_spectral"], rel=0.02)


@pytest.mark.slow
def test_a_white_capture_of_drawn_wavelengths_is_more_even_than_that_of_rays():
    """Where micro-images are lit evenly, only the wavelengths are noisy."""
    mi.set_variant("llvm_ad_spectral")
    scene = wall({"type": "uniform", "value": 1.0})
    deviations = []
    for model in ("wave", "ray"):
        images = np.array([render_capture(scene, model=model, spp=64, seed=seed).image for seed in range(4)])
        inner = images[0].mean(-1) > 0.9 * images[0].mean(-1).max()
        deviations.append(images.std(0, ddof=1)[inner].mean(0) / images.mean(0)[inner].mean(0))
    assert np.all(deviations[0] < [0.015, 0.005, 0.02])
    assert np.median(deviations[0] / deviations[1]) < 0.8


@pytest.mark.slow
def test_the_noise_is_that_of_seeds_and_of_wavelengths():
    mi.set_variant("llvm_ad_spectral")
    scene = wall(line(560, 20)[2], lenses=4)
    captures = [by_waves(scene, noise=True, seed=seed, nodes=1) for seed in range(8)]
    found = np.std([capture.image for capture in captures], axis=0, ddof=1)
    stated = np.mean([capture.noise**2 for capture in captures])
    assert math.sqrt(stated) == pytest.approx(math.sqrt((found**2).mean()), rel=0.2)


@pytest.mark.slow
def test_bands_are_the_means_of_lines():
    scene = scene_of(sensor(4, 16), wall=facing(240.0, 0.12, **radiating()))
    lines = [by_waves(scene, 2048, wavelength=wavelength).image for wavelength in (450.0, 650.0)]
    assert error(*lines) > 0.04
    # The two nodes of Gauss's rule; light is shared between them in straight lines.
    nodes = by_waves(scene, 2048, wavelength=550.0, bandwidth=2 * 100 * math.sqrt(3), nodes=2).image
    assert error(nodes, (lines[0] + lines[1]) / 2) < 0.6 * error(*lines)
    assert nodes.sum() == pytest.approx((lines[0].sum() + lines[1].sum()) / 2, rel=0.005)
    one = by_waves(scene, 64, wavelength=550.0, bandwidth=20.0, nodes=1).image
    assert np.array_equal(one, by_waves(scene, 64, wavelength=550.0).image)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "glass"), [(300.0, {}), (100.0, GLASS)], ids=["one focal length", "crown"])
def test_bands_of_a_patch_of_light_against_exact_sums(width, glass):
    scene = scene_of(sensor(6, 16, **glass), patch=facing(240.0, PATCH, (0.03, -0.05), **radiating()))
    options = {"wavelength": 550.0, "bandwidth": width}
    image = by_waves(scene, 2048, **options).image
    along = (np.arange(8) - 3.5) / 4 * PATCH
    points = np.array([(0.03 + x, -0.05 + y, 240.0) for x in along for y in along])
    spectrum = Spectrum.band(550, width, 8)
    operator = CaptureOperator(PlenopticCamera.from_sensor(scene.sensors()[0]), points, spectrum=spectrum)
    exact = operator.forward(np.ones((64, 8)))[..., 0]
    exact *= image.sum() / exact.sum()
    # Of so small a light that stands in focus, one line by itself is as far from exact sums.
    assert error(image, exact) < 0.05
    if glass:
        assert error(by_waves(scene, 2048, **options, nodes=1).image, exact) > 0.1


@pytest.mark.slow
def test_dispersing_lenses_keep_the_light_of_spectra():
    mi.set_variant("llvm_ad_spectral")
    options = {"nodes": 3, "spp": 16}
    for radiance in (line(532, 10)[2], {"type": "d65"}):
        plain, glass = (by_waves(wall(radiance, **more), **options).image.mean((0, 1)) for more in ({}, GLASS))
        assert glass == pytest.approx(plain, abs=0.02 * float(plain[1]))


@pytest.mark.slow
def test_lines_of_three_channels_have_rays_of_their_own():
    mi.set_variant("llvm_ad_rgb")
    light = facing(240.0, 0.2, **radiating())
    image = by_waves(scene_of(coloured(4, **GLASS), light=light), 256, wavelength="650, 550, 450").image
    mi.set_variant("llvm_ad_mono")
    camera = PlenopticCamera.from_sensor(mi.load_dict(sensor(4, 16, **GLASS)))
    for channel, wavelength in enumerate((650.0, 550.0, 450.0)):
        alone = camera.at_wavelength(wavelength)
        lens = {"focal_length": alone.focal_length, "mla_focal_length": alone.mla_focal_lengths[0]}
        lens["mla_distance"], lens["detector_distance"] = camera.mla_distance, camera.detector_distance
        scene = scene_of(sensor(4, 16, **lens), light=facing(240.0, 0.2, **radiating()))
        assert image[..., channel].sum() == pytest.approx(
            by_waves(scene, 256, wavelength=wavelength).image.sum(), rel=0.01
        )


def test_nodes_share_light_by_the_polynomial_through_them():
    mi.set_variant("llvm_ad_rgb")
    spectrum = colour.srgb()
    basis = colour.upsampling(spectrum.wavelengths)
    conversion = np.linalg.solve(basis @ spectrum.matrix().T, basis)
    nodes = SignedCapture(SMALL, None, spectrum, conversion, 4, 0.01).nodes
    weights = np.array([node.weights for node in nodes])
    # All light of white is shared, and reads 1 in every channel.
    assert weights.sum((0, 2)) == pytest.approx(np.ones(3), abs=1e-5)
    # What changes as a cubic polynomial of the wavelength is exact.
    offsets = (np.array(spectrum.wavelengths) - 550) / 150
    places = (np.array([node.plan.wavelength for node in nodes]) - 550) / 150
    for degree in (1, 2, 3):
        moments = (spectrum.matrix() * offsets**degree) @ conversion.T
        assert np.tensordot(places**degree, weights, 1) == pytest.approx(moments, rel=1e-4, abs=1e-5)


def test_drawn_wavelengths_integrate_responses():
    mi.set_variant("llvm_ad_spectral")
    capture = SignedCapture(SMALL, None, colour.srgb(), WavelengthSampler(colour.srgb_table()), 3, 0.01)
    nodes = capture.nodes
    count, places = 2**14, np.arange(380, 730, 0.05)
    for some in (nodes, nodes[1:2]):
        drawn = capture.conversion.draw((dr.arange(mi.Float, count) + 0.5) / count, span(some))
        for node in some:
            _, rows = node.mixture(drawn)
            found = [sum(dr.mean(weight)[0] for weight in row) for row in rows]
            others = [each.plan.wavelength for each in nodes if each is not node]
            shares = np.prod([(places - other) / (node.plan.wavelength - other) for other in others], axis=0)
            expected = np.trapezoid(colour.srgb_responses(places) * shares, places, axis=1)
            assert found == pytest.approx(expected[list(node.channels)], rel=0.002, abs=0.05)


def nodes_of(spectrum, camera, accuracy):
    """Return the wavelengths of all channels' nodes."""
    groups = node_spectra(camera, spectrum, accuracy)
    return sorted({node for _, of_channels in groups for node in of_channels.computed})


def test_nodes_are_as_many_as_spots_need():
    assert nodes_of(Spectrum.band(633, 20, 32), SMALL, 0.01) == pytest.approx([633.0])
    wide = Spectrum.band(550, 300, 32)
    coarse, fine = (nodes_of(wide, SMALL, accuracy) for accuracy in (0.01, 0.002))
    assert 1 < len(coarse) < len(fine) < 10
    # Crown glass shifts the focus.
    assert len(nodes_of(wide, SMALL.replace(glass={"index": 1.5168, "abbe": 64.2}), 0.01)) > len(fine)


def fast_lenses():
    """Return a camera with fast microlenses, whose pixels are eight spots wide."""
    return PlenopticCamera(
        focal_length=10.0, aperture_radius=10 / 3.6, mla_distance=12.0, mla_pitch=0.1, mla_focal_length=0.18,
        detector_distance=0.18, resolution=(60, 60), detector_width=0.6,
    )  # fmt: skip


def test_channels_share_a_node_where_pixels_cannot_tell_their_spots():
    lines = Spectrum.lines(611, 549, 464)
    camera = fast_lenses()
    assert nodes_of(lines, camera, 0.01) == pytest.approx([np.mean([611, 549, 464])])
    # Accurate captures, finer pixels, and lenses whose focus depends on the wavelength.
    assert nodes_of(lines, camera, 0.005) == [464.0, 549.0, 611.0]
    assert nodes_of(lines, camera.replace(resolution=(180, 180)), 0.01) == [464.0, 549.0, 611.0]
    assert nodes_of(lines, camera.replace(mla_glass={"index": 1.6, "abbe": 25.0}), 0.01) == [464.0, 549.0, 611.0]


@pytest.mark.slow
def test_captures_at_a_common_node_are_those_of_each_line():
    mi.set_variant("llvm_ad_rgb")
    values = mi.Bitmap(np.random.default_rng(0).random((12, 12, 1)).astype(np.float32))
    radiance = {"type": "bitmap", "bitmap": values, "filter_type": "bilinear", "raw": True}
    black = {"type": "diffuse", "reflectance": 0.0}
    wall = facing(58.0, 3.0, emitter={"type": "area", "radiance": radiance}, bsdf=black)
    film = fast_lenses().to_sensor()
    film["film"]["pixel_format"] = "rgb"
    scene = scene_of(film, wall=wall)
    common, own = (
        by_waves(scene, 1024, wavelength="611, 549, 464", **given).image for given in ({}, {"accuracy": 0.005})
    )
    for channel in range(3):
        assert 0 < error(common[..., channel], own[..., channel]) < 0.01


class _Elsewhere:
    """Computes every batch from what reaches another process of it."""

    workers, threads = 2, 0

    def __call__(self, batches):
        for batch in batches:
            yield pickle.loads(pickle.dumps(batch)).prepare()()


@pytest.mark.slow
def test_spectra_behind_panes_and_computed_elsewhere():
    mi.set_variant("llvm_ad_spectral")
    light = {"emitter": {"type": "area", "radiance": {"type": "d65"}}}
    pane = {"type": "mask", "opacity": 0.25, "nested": {"type": "diffuse", "reflectance": 0.0}}
    scene = scene_of(coloured(), pane=facing(200.0, 60.0, bsdf=pane), wall=facing(240.0, 60.0, **light))
    here, there = (by_waves(scene, nodes=2, batch_map=each).image for each in (None, _Elsewhere()))
    assert np.array_equal(here, there)
    rays = render_capture(scene, model="ray", spp=128).image
    assert here.mean((0, 1)) == pytest.approx(rays.mean((0, 1)), rel=0.03)


WIDE = PlenopticCamera(
    mla_pitch=0.25, detector_width=1.0, resolution=(32, 32), mla_glass={"index": 1.5168, "abbe": 64.2}
)
"""Behind its microlenses violet light is far from focus, and green light in focus."""


def test_rays_of_all_wavelengths_land_alike():
    lines = 413.5, 541.0, 650.0

    def nodes_of_lines(*wavelengths):
        return SignedCapture(WIDE, None, Spectrum.lines(*wavelengths), np.eye(len(wavelengths)), None, 0.01).nodes

    assert [nodes_of_lines(line)[0].plan.by_points for line in lines] == [True, False, False]
    nodes = nodes_of_lines(*lines)
    assert len(nodes) == 3 and all(node.plan.by_points for node in nodes)


@pytest.mark.slow
def test_light_in_focus_is_kept_beside_light_far_from_focus():
    mi.set_variant("llvm_ad_rgb")
    film = {"type": "hdrfilm", "width": 32, "height": 32, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    scene = scene_of(WIDE.to_sensor() | {"film": film}, wall=facing(240.0, 60.0, **radiating()))
    alone, beside = (
        by_waves(scene, 64, wavelength=wavelengths).image[..., 1].mean()
        for wavelengths in ("541, 541, 541", "650, 541, 413.5")
    )
    # Noise of 2 %.
    assert beside == pytest.approx(alone, rel=0.05)
