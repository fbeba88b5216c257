"""Guards of the physics: each fires on what it is there for, with the right number, and is silent otherwise."""

from dataclasses import replace
from math import erf

import mitsuba as mi
import numpy as np
import pytest
from scipy.special import j1

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.io.exr import read_exr
from mitsuba_plenoptic.optics import guards
from mitsuba_plenoptic.optics.waves import propagate
from mitsuba_plenoptic.points import arrival as full_field_grids
from mitsuba_plenoptic.points import patch_plan
from mitsuba_plenoptic.points.field_grid import Band
from mitsuba_plenoptic.rays.lens_choice import CHIEF
from mitsuba_plenoptic.refocus import write_reconstruction

WAVELENGTH = 633.0
SMALL = {"detector_width": 1.024, "resolution": (512, 512)}


def beam(n, width):
    """A gaussian beam of unit power on n x n samples of 2 um; width in samples."""
    x = np.arange(n) - (n - 1) / 2
    field = np.exp(-(x[None, :] ** 2 + x[:, None] ** 2) / width**2)
    return field / np.sqrt((field**2).sum())


def wave(n, column, row):
    """A plane wave of unit power, by its place in the spectrum."""
    k = np.arange(n)
    return np.exp(2j * np.pi * (column * k[None, :] + row * k[:, None]) / n) / n


class TestPropagation:
    @pytest.mark.parametrize("n, column, row", [(128, 3, -61), (900, 401, 7)])
    def test_content_at_the_band_limit(self, n, column, row):
        field = np.sqrt(0.95) * beam(n, n / 10) + np.sqrt(0.05) * wave(n, column, row)
        with pytest.warns(mp.PhysicsWarning) as caught:
            propagate(field, 2e-3, 0.05, WAVELENGTH)
        found = [str(warning.message) for warning in caught if "under-sampled" in str(warning.message)]
        assert len(found) == 1
        assert float(found[0].split("%")[0]) == pytest.approx(5, rel=0.05)

    def test_what_goes_round_a_small_window(self):
        """A beam in a window of six widths is warned of and, at ten widths, refused; a wider window is fine."""
        rayleigh = np.pi * (20 * 2e-3) ** 2 / (WAVELENGTH * 1e-6)
        with pytest.warns(mp.PhysicsWarning, match="outer eighth of its window"):
            propagate(beam(128, 20), 2e-3, 2.5 * rayleigh, WAVELENGTH)
        with pytest.raises(mp.PhysicsError, match="gone round the window"):
            propagate(beam(128, 20), 2e-3, 10 * rayleigh, WAVELENGTH)
        propagate(beam(1024, 20), 2e-3, 10 * rayleigh, WAVELENGTH)

    def test_the_share_in_the_rim_is_that_of_the_beam(self):
        """The closed form: a gaussian of width w has erf(2^1/2 a / w)^2 of its power within +-a."""
        inside = (erf(2**0.5 * 56 / 50) / erf(2**0.5 * 64 / 50)) ** 2
        with pytest.warns(mp.PhysicsWarning) as caught:
            propagate(beam(128, 50), 2e-3, 1e-4, WAVELENGTH)
        assert float(str(caught[0].message).split("%")[0]) == pytest.approx(100 * (1 - inside), rel=0.03)

    def test_a_warning_names_the_callers_line(self):
        with pytest.warns(mp.PhysicsWarning) as caught:
            propagate(np.ones((64, 64)), 2e-3, 1.0, WAVELENGTH)
        assert [warning.filename for warning in caught] == [__file__]


class TestPointSpreads:
    CAMERA = mp.PlenopticCamera(**SMALL)
    PLACE = (0.0, 0.0, 240.0)

    @pytest.mark.parametrize("cone, width, outcome", [(1.0, 25, "warned"), (0.5, 60, "refused")])
    def test_a_patch_with_a_narrow_band(self, monkeypatch, cone, width, outcome):
        monkeypatch.setattr(patch_plan, "band_for", lambda accuracy, count: Band(cone, width, 0, 0))
        if outcome == "refused":
            with pytest.raises(mp.PhysicsError, match="lost by the patches"):
                mp.point_spread_function(self.CAMERA, self.PLACE, wavelength=WAVELENGTH)
            return
        with pytest.warns(mp.PhysicsWarning, match="lost by the patches") as caught:
            psf = mp.point_spread_function(self.CAMERA, self.PLACE, wavelength=WAVELENGTH)
        # the detector holds all of the patch
        assert float(str(caught[0].message).split("%")[0]) == pytest.approx(100 * (1 - psf.sum()), abs=0.05)

    def test_what_is_hidden_from_the_pupil_or_cancels_is_no_loss(self):
        weights = np.ones((2, 4, 4), bool)
        weights[1] = False
        with guards.watch() as shares:
            mp.CaptureOperator(self.CAMERA, [self.PLACE] * 2, wavelength=633, pupil_weights=weights).forward([1, 1])
        assert 0 < shares["patch_loss"] < 0.02
        with guards.watch() as shares:
            mp.CaptureOperator(self.CAMERA, [self.PLACE] * 2, wavelength=633).forward([1, -1])
        assert "patch_loss" not in shares

    def test_what_gaps_between_the_lenses_stop_is_no_loss(self):
        """The closed form of a wide blur: the lenses' fraction of the area is behind the apertures."""
        camera = mp.PlenopticCamera(detector_width=1.536, resolution=(768, 768), mla_fill=0.5)
        with guards.watch() as fractions:
            psf = mp.point_spread_function(camera, (0.0, 0.0, 205.0), wavelength=WAVELENGTH)
        behind = camera.lattice.lens_area / camera.lattice.cell_area
        assert fractions["patch_loss"] == pytest.approx(1 - psf.sum() / behind, abs=0.015)
        assert 0.005 < fractions["patch_loss"] < 0.03

    def test_a_full_field_on_a_coarse_grid(self, monkeypatch):
        monkeypatch.setattr(full_field_grids, "_KEPT_BENDS", 0.3)
        monkeypatch.setattr(full_field_grids, "_KEPT_ORDERS", 3)
        camera = mp.PlenopticCamera(detector_width=1.024, resolution=(256, 256))
        with pytest.raises(mp.PhysicsError, match="directions that the grid does not hold"):
            mp.point_spread_function(camera, (0.0, 0.0, 210.0), wavelength=WAVELENGTH, method="full_field")


class TestReconstruction:
    CAMERA = mp.PlenopticCamera(**SMALL)

    def test_grey_is_no_capture_and_one_warning_says_so(self):
        """Light beside the micro-images: 1 - pi/4 (43 / 64)^2 = 65 % of it, and three channels still warn once."""
        with pytest.warns(mp.PhysicsWarning) as caught:
            options = {"camera": self.CAMERA, "wavelength": [633, 550, 460], "interleave": "auto"}
            result = mp.reconstruct(np.ones((512, 512, 3)), 240, method="partial", **options)
        assert len(caught) == 1
        assert result.guards["outside_pupil"] == pytest.approx(1 - mp.design.white_mean(self.CAMERA), abs=0.05)

    @pytest.mark.filterwarnings("ignore:.*does not go back through the main lens")
    @pytest.mark.parametrize(("options", "bins"), [({"method": "coherent"}, 6), ({"interleave": "auto"}, 4.5)])
    def test_light_that_leaves_the_object_window(self, options, bins, tmp_path):
        """The Airy pattern of a pupil of f/180 beyond the window's margin, integrated over its disc."""
        camera = self.CAMERA.replace(aperture_radius=0.22)
        image = np.zeros((512, 512), np.float32)
        image[261:283, 261:283] = 1
        with pytest.warns(mp.PhysicsWarning, match="diffracted beyond the computed window"):
            result = mp.reconstruct(image, 240, camera=camera, wavelength=633, **{"method": "partial", **options})
        edge = 2 * np.pi * 0.22 * bins * 0.064 / (633e-6 * 120)
        radius = (np.arange(1000) + 0.5) / 1000 * edge
        within = ((2 * j1(radius) / radius) ** 2 * radius).sum() * edge / 1000 / 2
        assert result.guards["object_window"] == pytest.approx(1 - within, rel=0.01)
        write_reconstruction(tmp_path / "out.exr", result)
        assert read_exr(tmp_path / "out.exr")[2]["guards"] == result.guards


def test_one_lens_where_three_are_needed(camera_dict):
    """The ray camera is made to try one lens only: a quarter of the light is missed, and nothing is rendered."""
    scene = mi.load_dict({"type": "scene", "i": {"type": "path"}, "s": camera_dict(aperture_radius=10.0)})
    mp.render_capture(scene, spp=1)
    sensor = scene.sensors()[0]
    sensor._rays = replace(sensor._rays, choice=CHIEF)
    with pytest.raises(mp.PhysicsError, match=r"^27\..*through microlenses that are too far"):
        mp.render_capture(scene, spp=1)


@pytest.mark.filterwarnings("default::mitsuba_plenoptic.PhysicsWarning")
def test_the_command_shows_one_line(tmp_path, capsys):
    given = tmp_path / "camera.json"
    # The lenses that are tried are those around the chief ray's lens, which is found for slow changes of its shift.
    cra = {"mla_cra": (0, 0, 0.25, 0, 0.2505, 8.0)}
    camera = mp.PlenopticCamera(resolution=(64, 64), detector_width=1.024, aperture_radius=7.3, **cra)
    given.write_text(camera.to_json())
    assert main(["render", "white", "-o", str(tmp_path / "raw.exr"), "--spp", "1", "--camera", str(given)]) == 0
    # One more line tells that so large pixels do not refocus.
    (line,) = (each for each in capsys.readouterr().err.splitlines() if "warning" in each and "refocusing" not in each)
    assert line.startswith("mitsuba-plenoptic: warning: 0.2")
