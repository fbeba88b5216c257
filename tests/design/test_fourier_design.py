"""The design of Fourier light-field microscopes, against numbers of Guo et al. 2019 and closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import design
from mitsuba_plenoptic.plugins.other_camera import with_camera
from mitsuba_plenoptic.report.experiment import Settings, run_experiment
from mitsuba_plenoptic.report.sheet import design_sheet

LENS = mp.Objective(40, 0.95, arrangement="fourier", fourier_focal_length=75)
GUO = mp.PlenopticCamera(
    main_lens=LENS, mla_pitch=0.6, mla_offset=(0.3, 0.3), mla_focal_length=16.8, detector_width=3.9,
    resolution=(600, 600),
)  # fmt: skip


def stopped(camera, **changes):
    """Return a camera whose objective has some values changed."""
    return camera.replace(main_lens=replace(camera.objective, **changes))


def test_the_published_microscope_performs_as_published():
    assert design.lenses_across_stop(GUO) == pytest.approx(5.9375)
    assert design.view_resolution(GUO, 680) == pytest.approx(2.12e-3, rel=3e-3)
    assert design.native_field(GUO) == pytest.approx(66.96e-3, rel=1e-4)
    # Half of the depth of field that the paper counts on; a pixel is 1 / 2.93 of the resolution.
    assert design.view_depth(GUO, 680) == pytest.approx(32e-3, rel=0.03)
    # The paper takes tan(theta) as sin(theta), and the lens at (1, 1); that at (2, 1) is whole, too.
    sine = 40 * 0.6 * math.sqrt(5) / 75
    assert design.depth_step(GUO, 680) == pytest.approx(2.125e-3 * math.sqrt(1 - sine**2) / sine)
    steep = stopped(GUO, numerical_aperture=0.51)
    sine = 40 * 0.6 / 75
    assert design.depth_step(steep, 680) == pytest.approx(2.125e-3 * math.sqrt(1 - sine**2) / sine)
    assert design.depth_step(stopped(GUO, numerical_aperture=0.3), 680) == math.inf


@pytest.mark.parametrize(("lattice", "shape", "rotation", "apart"), [
    ("square", "disc", 0, 1),
    ("square", "square", 0, 1),
    ("square", "square", 45, math.sqrt(0.5)),
    ("hexagonal", "disc", 20, 1),
    ("hexagonal", "square", 0, math.sqrt(0.75)),
])  # fmt: skip
def test_micro_images_touch_by_the_lattice_and_the_shape_of_the_field_stop(lattice, shape, rotation, apart):
    camera = stopped(GUO, field_stop_shape=shape).replace(mla_lattice=lattice, mla_rotation=rotation)
    stop = 75 * 0.6 * apart / (2 * 16.8)
    assert design.touching_field_stop(camera) == pytest.approx(stop)
    assert design.overlap_warnings(stopped(camera, field_stop=0.9999 * stop)) == []
    (text,) = design.overlap_warnings(stopped(camera, field_stop=1.01 * stop))
    offered = float(text.partition("take a field_stop of ")[2].split()[0])
    assert offered == pytest.approx(stop, rel=1e-5)
    assert design.overlap_warnings(stopped(camera, field_stop=offered)) == []


def test_faults_are_warned_of_and_mended():
    assert (
        design.overlap_warnings(mp.PlenopticCamera()) == design.overlap_warnings(mp.PlenopticCamera.preset("lfm")) == []
    )
    (text,) = design.design_warnings(GUO)
    assert "no field_stop" in text
    mended = design.mended(GUO)
    assert design.design_warnings(mended) == []
    assert mended.objective.field_stop == pytest.approx(75 * 0.6 / 33.6, rel=1e-5)
    wide = design.design_warnings(stopped(GUO, field_stop=9))
    assert any(text.startswith("field_stop = 9: ") and f"{1.95 * 75 / 16.8:.6g} mm" in text for text in wide)
    few = stopped(GUO, numerical_aperture=0.3)
    assert any("only 1.9 lenses" in text for text in design.design_warnings(few))
    assert design.design_warnings(design.mended(few)) == []
    assert design.lenses_across_stop(design.mended(few)) == pytest.approx(2)


@pytest.mark.parametrize(
    ("name", "across", "whole", "field"), [("flfm", 6.996, 37, 0.101), ("flfm_oil", 3.45, 5, 0.108)]
)
def test_presets_suit_and_capture_beads(name, across, whole, field, recwarn):
    camera = mp.PlenopticCamera.preset(name)
    assert design.design_warnings(camera, 550) == []
    assert design.lenses_across_stop(camera) == pytest.approx(across, rel=2e-3)
    assert (design.lenses_in_stop(camera)[1] >= 0.99).sum() == whole
    assert design.native_field(camera) > field
    assert camera.objective.field_stop == pytest.approx(design.touching_field_stop(camera), rel=3e-5)
    assert 2 <= design.view_resolution(camera, 550) / camera.bin_size(0) <= 3.2
    rows = {(row.group, row.quantity): row.value for row in design_sheet(camera, 550)}
    assert rows["Diffraction at 550 nm", "depth step"] == f"{1e3 * design.depth_step(camera, 550):.4g}"
    middle = tuple(size // 2 - 40 for size in camera.resolution)
    part = camera.replace(crop_offset=middle, crop_size=(80, 80))
    scene = mp.load_scene("beads", variant="llvm_ad_mono")
    ray, wave = (
        mp.render_capture(with_camera(scene, part, None), model=model, spp=256, **light)
        for model, light in (("ray", {}), ("wave", {"wavelength": 550}))
    )
    assert np.sum(wave.image) == pytest.approx(np.sum(ray.image), rel=0.25)
    assert not any("overlap" in str(warning.message) for warning in recwarn)


def test_a_capture_of_a_scene_without_a_field_stop_warns_of_overlap():
    scene = with_camera(mp.load_scene("beads", variant="llvm_ad_mono"), GUO.replace(resolution=(60, 60)), None)
    with pytest.warns(UserWarning, match=r"overlap: no field_stop .* 1.3392\d mm"):
        mp.render_capture(scene, model="ray", spp=1)


def test_comparisons_name_what_works_where_the_array_is_in_the_image():
    settings = Settings("beads", camera=mp.PlenopticCamera.preset("lfm").to_dict(), distances=(0.01,))
    refuses("main_lens = 20x/0.5 objective: .*deconvolved", run_experiment, settings, None)
