"""Nodes of spectra of captures by signed rays: how they share light, and how many there are."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera, Spectrum
from mitsuba_plenoptic.optics import colour
from mitsuba_plenoptic.waves.signed_capture import SignedCapture
from mitsuba_plenoptic.waves.spectral_nodes import WavelengthSampler, node_spectra, span

CROWN = {"index": 1.5168, "abbe": 64.2}
SMALL = PlenopticCamera(resolution=(64, 64), detector_width=0.128)


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
    groups = node_spectra(camera, spectrum, accuracy)
    return sorted({node for _, of_channels in groups for node in of_channels.computed})


def test_nodes_are_as_many_as_spots_need():
    assert nodes_of(Spectrum.band(633, 20, 32), SMALL, 0.01) == pytest.approx([633.0])
    wide = Spectrum.band(550, 300, 32)
    coarse, fine = (nodes_of(wide, SMALL, accuracy) for accuracy in (0.01, 0.002))
    assert 1 < len(coarse) < len(fine) < 10
    # Crown glass shifts the focus.
    assert len(nodes_of(wide, SMALL.replace(glass=CROWN), 0.01)) > len(fine)


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


WIDE = PlenopticCamera(mla_pitch=0.25, detector_width=1.0, resolution=(32, 32), mla_glass=CROWN)
"""Behind its microlenses violet light is far from focus, and green light in focus."""


def test_rays_of_all_wavelengths_land_alike():
    lines = 413.5, 541.0, 650.0

    def nodes_of_lines(*wavelengths):
        return SignedCapture(WIDE, None, Spectrum.lines(*wavelengths), np.eye(len(wavelengths)), None, 0.01).nodes

    assert [nodes_of_lines(line)[0].plan.lands_by_point for line in lines] == [True, False, False]
    nodes = nodes_of_lines(*lines)
    assert len(nodes) == 3 and all(node.plan.lands_by_point for node in nodes)
