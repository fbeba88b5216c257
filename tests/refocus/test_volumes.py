"""Volumes of refocused planes, and estimates of what reconstructions take."""

import json
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import tifffile
from cameras import HALF, WAVELENGTH, small_camera
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import PlenopticCamera, Reconstruction, estimate_reconstruction, reconstruct
from mitsuba_plenoptic.refocus import Volume, api, write_volume
from mitsuba_plenoptic.runtime import progress
from mitsuba_plenoptic.views import capture_white, white_image

SMALL = PlenopticCamera(detector_width=0.384, resolution=(192, 192))


def made(distance, image, oversample=1):
    size = SMALL.bin_size(distance) / oversample
    return Reconstruction(np.asarray(image, np.float32), distance, size, "deconvolved", SMALL)


def test_voxels_show_the_same_place_of_every_plane():
    """A slope in the scene, sampled by bins that grow with the distance, is that slope in all planes."""

    def bins(distance, count=24):
        x = ((count - 1) / 2 - np.arange(count)) * SMALL.bin_size(distance) / 4
        return made(distance, 10 + 3 * x - 2 * x[:, None], 4)

    volume = Volume.of([bins(280.0), bins(210.0), bins(245.0)])
    assert volume.distances == (210.0, 245.0, 280.0)
    assert volume.voxel_size == pytest.approx(SMALL.bin_size(210.0) / 4)
    assert volume.values.shape == (3, 32, 32)
    cube = volume.to_xarray()
    expected = 10 + 3 * cube.x - 2 * cube.y
    for plane in cube:
        seen = ~np.isnan(plane.values)
        half = 24 * SMALL.bin_size(float(plane.distance)) / 8
        inside = (np.abs(cube.x) <= half - 1e-9) & (np.abs(cube.y) <= half - 1e-9)
        np.testing.assert_array_equal(seen, inside.transpose("y", "x").values)
        # Beyond the centre of the last bin its value goes on.
        inner = ((np.abs(cube.x) < 0.9 * half) & (np.abs(cube.y) < 0.9 * half)).transpose("y", "x").values
        np.testing.assert_allclose(plane.values[inner], expected.transpose("y", "x").values[inner], atol=1e-4)


def test_files_hold_voxel_sizes(tmp_path):
    random = np.random.default_rng(0)
    volume = Volume(random.random((4, 5, 6)).astype(np.float32), (210.0, 220.0, 230.0, 240.0), 0.03, {"a": [1]})
    write_volume(tmp_path / "a.tif", volume)
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        told, tags = file.imagej_metadata, file.pages[0].tags
        assert told["spacing"] == 10_000 and told["unit"] == "um" and told["slices"] == 4
        assert json.loads(told["Info"]) == {"distances": [210, 220, 230, 240], "a": [1]}
        numerator, denominator = tags["XResolution"].value
        assert denominator / numerator == pytest.approx(30, rel=1e-6)
        np.testing.assert_array_equal(file.asarray(), volume.values)
    uneven = Volume(random.random((3, 5, 6, 3)).astype(np.float32), (210.0, 220.0, 250.0), 0.03)
    refuses(r"distance = 210, 220, 250: planes of a .tif are evenly spaced", write_volume, tmp_path / "b.tif", uneven)
    write_volume(tmp_path / "b.ome.tif", uneven)
    with tifffile.TiffFile(tmp_path / "b.ome.tif") as file:
        np.testing.assert_array_equal(np.moveaxis(file.asarray(), 1, -1), uneven.values)
        entries = ElementTree.fromstring(file.ome_metadata).iter()
    pixels = next(entry for entry in entries if entry.tag.endswith("Pixels"))
    assert float(pixels.attrib["PhysicalSizeX"]) == 30 and pixels.attrib["PhysicalSizeXUnit"] == "µm"
    assert "PhysicalSizeZ" not in pixels.attrib
    planes = [entry.attrib for entry in pixels if entry.tag.endswith("Plane")]
    assert {int(plane["TheZ"]): float(plane["PositionZ"]) for plane in planes} == {0: 210_000, 1: 220_000, 2: 250_000}
    for name in ("c.png", "c"):
        refuses(r"give a name that ends in .tif or", write_volume, tmp_path / name, volume)


def test_views_are_those_of_numpy():
    values = np.zeros((3, 4, 5), np.float32)
    values[1, 2, 3], values[2, 0, 0], values[0, 3, 4] = 5, 2, np.nan
    volume = Volume(values, (210.0, 220.0, 240.0), 0.1)
    assert volume.maximum("z")[2, 3] == 5 and volume.maximum("z")[0, 0] == 2 and volume.maximum("z")[3, 4] == 0
    assert volume.maximum("y").shape == (3, 5) and volume.maximum("y")[1, 3] == 5
    assert volume.maximum("x").shape == (3, 4) and volume.maximum("x")[2, 0] == 2
    front, above, side = volume.slices()
    np.testing.assert_array_equal(front, values[1])
    np.testing.assert_array_equal(above, values[:, 2])
    np.testing.assert_array_equal(side, values[:, :, 3])
    refuses("row = 4: the volume's are numbered from 0 to 3", volume.slices, row=4)


WAVES = {"wavelength": WAVELENGTH}
DECONVOLVED = pytest.param("deconvolved", {"iterations": 3} | WAVES, marks=pytest.mark.needs_extension("deconvolution"))


@pytest.fixture(scope="module")
def capture():
    camera = small_camera(8, **HALF)
    return mp.Capture(white_image(camera), camera)


@pytest.mark.parametrize(("method", "options"), [("coherent", WAVES), DECONVOLVED])
def test_an_estimate_ends_before_the_reconstruction_does(capture, method, options, monkeypatch):
    """With a speed known from the first results on, no method by waves may reach its end."""
    monkeypatch.setattr(progress, "SETTLED", 0.0)
    ended, whole = [], api._refocused
    monkeypatch.setattr(api, "_refocused", lambda *given: (whole(*given), ended.append(True))[0])
    cost = estimate_reconstruction(capture, 105.0, method=method, **options)
    assert not ended and cost.seconds > 0 and cost.memory > 0


def test_short_work_is_done_for_its_estimate(capture, monkeypatch):
    monkeypatch.setattr(progress, "SETTLED", 1e9)
    assert 0 < estimate_reconstruction(capture, [105.0, 120.0]).seconds < 1e3


@pytest.mark.parametrize(
    ("method", "options"),
    [("ray", {}), pytest.param(*DECONVOLVED.values, marks=[*DECONVOLVED.marks, pytest.mark.slow])],
)
def test_the_memory_of_an_estimate_is_what_is_refused(capture, method, options, monkeypatch):
    # What is kept for the camera needs its memory once.
    reconstruct(capture, 105.0, method=method, **options)
    needed = estimate_reconstruction(capture, 105.0, method=method, **options).memory
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", f"{1.01 * needed / 2**30:.9f}")
    reconstruct(capture, 105.0, method=method, **options)
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", f"{0.99 * needed / 2**30:.9f}")
    with pytest.raises(mp.InputError, match="GiB"):
        reconstruct(capture, 105.0, method=method, **options)


def test_fields_take_strips_where_memory_is_short(capture, monkeypatch):
    monkeypatch.setattr(progress, "SETTLED", 0.0)
    needed = estimate_reconstruction(capture, 105.0, method="coherent", **WAVES).memory
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", f"{0.99 * needed / 2**30:.9f}")
    assert estimate_reconstruction(capture, 105.0, method="coherent", **WAVES).memory < 0.99 * needed


def test_long_work_says_its_time_and_memory(capture, monkeypatch, caplog):
    caplog.set_level("INFO", logger="mitsuba_plenoptic")
    reconstruct(capture, 115.0, method="coherent", white=capture, **WAVES)
    assert "takes about" not in caplog.text
    monkeypatch.setattr(progress, "SETTLED", 0.0)
    monkeypatch.setattr(api, "_LONG", 0.0)
    reconstruct(capture, 115.0, method="coherent", white=capture, **WAVES)
    assert re.search(r"method coherent takes about \S+ s and \S+ GiB; method ray", caplog.text)
    assert caplog.text.count("takes about") == 1


def test_whites_by_waves_report_while_they_are_computed():
    camera = mp.PlenopticCamera(resolution=(128, 128), detector_width=0.512)
    seen = []
    capture_white(mp.Capture(white_image(camera), camera, 550.0, "wave"), 1, lambda done, of: seen.append(done / of))
    assert seen == sorted(seen) and seen[-1] == 1.0 and len(seen) > 10


def test_the_command_prints_time_and_memory_and_writes_nothing(capture, tmp_path, run, complaint):
    path = tmp_path / "raw.exr"
    mp.write_capture(path, capture)
    arguments = ["reconstruct", path, "--distance", "105", "--method", "coherent", "--wavelength", "633"]
    said = run(*arguments, "-o", tmp_path / "out.png", "--estimate")
    assert re.search(r"raw\.exr: about \S+ (s|min) and \S+ GiB\n$", said)
    assert list(tmp_path.iterdir()) == [path]
    assert "--estimate" in complaint(*arguments)
