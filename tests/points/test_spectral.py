"""Captures by waves of many wavelengths: against each by itself, and against Mitsuba's colours by rays."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import error
from cases import facing, radiating, scene_of

from mitsuba_plenoptic import CaptureOperator, InputError, PlenopticCamera, Spectrum, render_capture
from mitsuba_plenoptic.optics import colour
from mitsuba_plenoptic.points.mixing import WeightChannels
from mitsuba_plenoptic.points.spectral import with_enough_nodes

CAMERA = PlenopticCamera(
    focal_length=40, aperture_radius=2.5, mla_distance=60, resolution=(192, 192), detector_width=0.384,
    lens_model="parabolic",
)  # fmt: skip
POINTS = np.array([(0.0, 0.0, 120.0), (0.1, -0.05, 112.0), (-0.12, 0.1, 130.0)])


def alone(camera, wavelength, weights):
    """What one wavelength by itself makes of the points, its camera's numbers put in by hand."""
    return CaptureOperator(camera.at_wavelength(wavelength), POINTS, wavelength=wavelength, accuracy=0).forward(weights)


@pytest.mark.slow
def test_nodes_against_every_wavelength_by_itself():
    """16 wavelengths, light that changes with the wavelength, two channels, at a fraction of the spreads."""
    wavelengths = np.linspace(450, 650, 16)
    responses = np.stack([np.exp(-(((wavelengths - middle) / 40) ** 2)) for middle in (520, 590)])
    spectrum = Spectrum(tuple(wavelengths.tolist()), tuple(map(tuple, responses.tolist())))
    chosen = with_enough_nodes(CAMERA, POINTS, spectrum, 0.008)
    assert 1 < len(chosen.nodes) <= 12
    weights = 1 + np.sin(wavelengths / 17 + np.arange(3)[:, None])
    found = CaptureOperator(CAMERA, POINTS, spectrum=chosen, accuracy=0).forward(weights)
    each = [alone(CAMERA, wavelength, column) for wavelength, column in zip(wavelengths, weights.T, strict=True)]
    expected = np.moveaxis(np.tensordot(responses, np.array(each), 1), 0, -1)
    assert max(error(found[..., i], expected[..., i]) for i in range(2)) < 0.008
    # One node is not enough, and the function must have seen it.
    coarse = CaptureOperator(CAMERA, POINTS, spectrum=spectrum.interpolated(1), accuracy=0).forward(weights)
    assert error(coarse[..., 0], expected[..., 0]) > 0.008


def test_columns_are_as_few_as_the_spectra_need():
    """One for points of one spectrum; with others as many as keep what is told within the error."""
    wavelengths = np.linspace(450, 650, 16)
    responses = np.stack([np.exp(-(((wavelengths - middle) / 40) ** 2)) for middle in (600, 540, 480)])
    spectrum = Spectrum(tuple(wavelengths.tolist()), tuple(map(tuple, responses.tolist()))).interpolated(6)
    rng = np.random.default_rng(3)
    same = rng.random((40, 1)) * (1 + np.sin(wavelengths / 17))
    smooth = rng.random((40, 1)) * (1 + 0.3 * np.sin(wavelengths / 90 + 6 * rng.random((40, 1))))
    rough = rng.random((40, 16))
    counts = {}
    for name, weights in (("same", same), ("smooth", smooth), ("rough", rough)):
        whole = np.sqrt(np.square(weights @ responses.T).sum(0))
        for part in WeightChannels(None, spectrum).parts(len(spectrum.wavelengths)):
            made = part.reduced(weights, 1e-3 * whole)
            left = (weights @ made.before) @ made.after.T - (weights @ part.before) @ part.after.T
            assert np.all(np.sqrt(np.square(left).sum(0)) <= 1.01e-3 * whole)
            counts.setdefault(name, []).append(made.before.shape[1])
    assert max(counts["same"]) == 1
    assert sum(counts["smooth"]) < 3 * 6
    assert max(counts["rough"]) == 3


def before(board, others=None, **film):
    described = CAMERA.replace(resolution=(64, 64), detector_width=0.128).to_sensor()
    described["film"] |= film
    return scene_of(described, board=facing(125.0, 10.0, **board), **(others or {}))


TABLE = {"type": "regular", "wavelength_min": 400.0, "wavelength_max": 700.0, "values": "0.5, 0.5"}
SKY = {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}


@pytest.mark.parametrize(
    ("board", "others", "message"),
    [
        (radiating({"type": "rgb", "value": [1, 1, 1]}), {}, "wavelength = 850: emitter board"),
        ({"bsdf": {"type": "diffuse", "reflectance": TABLE}}, {"sky": SKY}, "surface board .* 400 to 700 nm"),
    ],
)
def test_light_that_mitsuba_does_not_know_is_refused(board, others, message):
    mi.set_variant("llvm_ad_spectral")
    with pytest.raises(InputError, match=message):
        render_capture(before(board, others), model="wave", spp=4, wavelength=850)


def test_bands_and_responses_that_make_no_sense_are_refused(tmp_path):
    mi.set_variant("llvm_ad_rgb")
    table = tmp_path / "sensor.csv"
    table.write_text("wavelength,a,b\n400,1,1\n700,1,1\n")
    scene = before(radiating(), pixel_format="rgb")
    for options, message in [
        ({"responses": str(table)}, "2 channels"),
        ({"responses": "none.csv"}, "none.csv"),
        ({"responses": "srgb", "bandwidth": 20.0}, "responses, bandwidth"),
        ({"wavelength_count": 5}, "wavelength_count"),
        ({"bandwidth": 1000.0}, "bandwidth = 1000"),
    ]:
        with pytest.raises(InputError, match=message):
            render_capture(scene, model="wave", spp=1, **options)


def test_spectra_of_colours():
    """Upsampled spectra have their colours again, by Mitsuba's tables, and lie in [0, 1] times D65."""
    mi.set_variant("llvm_ad_rgb")
    wavelengths = tuple(np.arange(360, 830.5, 1.0).tolist())
    basis = colour.upsampling(wavelengths)
    assert basis @ colour.srgb_responses(np.array(wavelengths)).T == pytest.approx(np.eye(3), abs=0.01)
    assert basis.min() >= 0 and basis.sum(0) == pytest.approx(np.array(mi.cie_d65(mi.Float(wavelengths))), rel=1e-6)
