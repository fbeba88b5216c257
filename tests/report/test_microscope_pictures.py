"""Pictures through an objective without the array, against a closed form, and the comparison whose truth they are."""

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import Objective, PlenopticCamera, reconstruct, render_capture
from mitsuba_plenoptic.report import Settings, comparison, methods_of_both, objective_image
from mitsuba_plenoptic.report.photographs import thin_lens_image

# Seven whole lenses, and none that the stop cuts.
CAMERA = PlenopticCamera(
    main_lens=Objective(20, 0.5, arrangement="fourier", fourier_focal_length=90.0, field_stop=2.5),
    mla_pitch=1.667, mla_lattice="hexagonal", mla_aperture="circle", mla_fill=0.6, mla_focal_length=25.0,
    detector_width=5.2, resolution=(104, 104),
)  # fmt: skip


def test_light_out_of_focus_is_that_of_the_part_of_the_stop_that_sees_it():
    place = mi.ScalarTransform4f().translate([0.5, 0.5, 0.03]).rotate([0, 1, 0], 180).scale(0.5)
    quadrant = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": 1.0}}
    camera = {"camera": CAMERA.to_sensor(), "integrator": {"type": "path"}}
    scene = mi.load_dict({"type": "scene", "quadrant": quadrant, **camera})
    image = objective_image(scene, CAMERA, 0.0, 4096, (40, 30), 0.01)
    x, y = (np.arange(count, 0, -1) * 0.01 - 0.5 * 0.01 * (count + 1) for count in (40, 30))
    # Rays through the stop, evenly in sines, 0.03 mm on, from random points of a pixel.
    rng = np.random.default_rng(0)
    sines = (sines := rng.uniform(-0.5, 0.5, (2, 20000)))[:, np.hypot(*sines) <= 0.5]
    dx, dy = 0.03 * sines / np.sqrt(1 - (sines**2).sum(0)) + rng.uniform(-0.005, 0.005, sines.shape)
    seen = np.array([[np.mean((at + dx > 0) & (up + dy > 0)) for at in x] for up in y])
    radius = np.hypot(x, y[:, None])
    assert np.isnan(image[radius > 0.135]).all()
    np.testing.assert_allclose(image[radius < 0.115], seen[radius < 0.115], atol=0.02)
    for result in reconstruct(render_capture(scene, model="ray", spp=64), [0.0, 0.03], method="ray"):
        truth = thin_lens_image(scene, CAMERA, result.distance, 256)
        assert np.nanstd(result.image - truth) < 0.06 and abs(np.nanmean(result.image - truth)) < 0.01


def test_a_comparison_in_the_fourier_arrangement(tmp_path):
    spent = {"spp": 16, "truth_spp": 64, "noise": True, "pdf": False, "methods": methods_of_both(["coherent"])}
    results = comparison.compare(Settings("beads", camera=CAMERA.to_dict(), distances=(-0.03,), **spent), tmp_path)
    assert [row["method"] for row in results["reconstructions"]] == ["ray_of_ray", "ray"]
    assert results["reconstructions"][1]["psnr"] > 15 and "noise" in results["answer"]
