"""Deconvolution's longer runs: checkpoints, workers, volumes whose kernels lie on disk, and total variation."""

import json

import numpy as np
import OpenEXR
import pytest
import tifffile
from cameras import WAVELENGTH, small_camera
from refusals import refuses
from stopped_runs import StoppedError
from test_fourier_microscope import SMALL as FOURIER

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.extensions.deconvolution import fourier
from mitsuba_plenoptic.extensions.deconvolution import response as response_module
from mitsuba_plenoptic.extensions.deconvolution.options import MOST_VARIATION
from mitsuba_plenoptic.extensions.deconvolution.response import Response
from mitsuba_plenoptic.extensions.deconvolution.variation import TotalVariation
from mitsuba_plenoptic.io import checkpoints
from mitsuba_plenoptic.points import Recorder
from mitsuba_plenoptic.runtime.batches import Threads
from mitsuba_plenoptic.views import white_image

SMALL, TINY = small_camera(6), small_camera(4)


def test_variation_is_that_of_an_even_slope():
    """The gradient against finite differences of the sum of lengths, and of an even slope, where it is 0 inside."""
    variation, random = TotalVariation(lambda values: [values], 1.0), np.random.default_rng(0)
    rows, columns = np.indices((12, 17))
    even = variation((5 + 3 * columns - 2 * rows).astype(np.float32), np.ones((12, 17), bool)).reshape(12, 17)
    np.testing.assert_allclose(even[1:-1, 1:-1], 0, atol=1e-5)
    np.testing.assert_allclose(even[1:-1, 0], -3 / np.sqrt(13), rtol=1e-3)
    values, inside = random.random((12, 17)), random.random((12, 17)) > 0.1
    direction = random.standard_normal((12, 17)) * inside

    def total(t):
        moved = np.where(inside, values + t * direction, np.nan)
        right, below = np.diff(moved, axis=1, append=np.nan), np.diff(moved, axis=0, append=np.nan)
        even = 1e-3 * values[inside].mean()
        return np.sqrt(np.nan_to_num(right) ** 2 + np.nan_to_num(below) ** 2 + even**2).sum()

    found = variation(values.astype(np.float32), inside).reshape(12, 17)
    assert np.abs(found).max() <= 2 + np.sqrt(2) < 1 / MOST_VARIATION
    assert (found * direction).sum() == pytest.approx((total(1e-5) - total(-1e-5)) / 2e-5, rel=1e-2)


def random_light(camera=TINY, channels=(3,), wavelengths=(633.0, 500.0, 450.0)):
    image = np.random.default_rng(0).random((*camera.shape, *channels), np.float32)
    return mp.Capture(image, camera, wavelengths, "wave", {})


def test_variation_makes_planes_more_even():
    options = {"method": "deconvolved", "response": "ray", "iterations": 10}
    plain, even = (mp.reconstruct(random_light(), 253.0, variation=weight, **options).image for weight in (0.0, 0.01))
    assert abs(np.diff(even, axis=0)).sum() < 0.95 * abs(np.diff(plain, axis=0)).sum()


ON_DISK = {"volume": True, "oversample": 2, "variation": 0.002}
RUNS = {
    "a later plane and channel": (random_light(), [253.0, 235.0], {"response": "ray", "variation": 0.005}, 11),
    "spectra on disk": (random_light(FOURIER, (), WAVELENGTH), [0.0, 0.03], ON_DISK, 2),
}


@pytest.mark.parametrize("name", RUNS)
def test_a_deconvolution_goes_on_where_it_was_stopped(tmp_path, monkeypatch, name):
    """The bits of one that was not stopped, also where the rest has its spectra on disk instead of in memory."""
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    monkeypatch.setattr(checkpoints, "FRACTION", 1e9)
    capture, distances, options, stop = RUNS[name]
    path, options = tmp_path / "out.checkpoint", {"method": "deconvolved", "iterations": 3} | options
    whole = mp.reconstruct(capture, distances, **options)
    save, count = mp.Checkpoint.save_arrays, [0]

    def stopped(self, arrays):
        save(self, arrays)
        count[0] += 1
        if count[0] == stop:
            raise StoppedError

    def resumed(existing="resume", **others):
        with mp.Checkpoint(path, existing) as checkpoint:
            return mp.reconstruct(capture, distances, checkpoint=checkpoint, **(options | others))

    with monkeypatch.context() as patch:
        patch.setattr(mp.Checkpoint, "save_arrays", stopped)
        with pytest.raises(StoppedError):
            resumed("refuse")
    refuses("iterations = 3 there, 5 here", resumed, iterations=5)
    monkeypatch.setattr(fourier, "_MEMORY", 0)
    for ours, theirs in zip(resumed(), whole, strict=True):
        np.testing.assert_array_equal(ours.image, theirs.image)
        assert ours.facts == theirs.facts
    assert not path.exists()


def test_kernels_on_disk_are_those_in_memory(monkeypatch):
    distances = [230.0, 250.0]
    inside = Response(SMALL, distances, wavelength=None, oversample=2)
    values = np.random.default_rng(0).random(inside.source_shape).astype(np.float32)
    image = inside.forward(values)
    monkeypatch.setattr(response_module, "_MEMORY", 2**20)
    with Response(SMALL, distances, wavelength=None, oversample=2) as outside:
        blocks = [block for plane in outside.planes for zone in plane._zones for block in zone.blocks]
        assert all(isinstance(block.matrix, np.memmap) for block in blocks)
        np.testing.assert_array_equal(outside.forward(values), image)
        np.testing.assert_array_equal(outside.adjoint(image), inside.adjoint(image))


HEXAGONAL = SMALL.replace(mla_lattice="hexagonal")


@pytest.mark.parametrize("camera", [HEXAGONAL, SMALL.replace(mla_aperture="circle", detector_blur=0.003)])
def test_zones_make_the_pixels_that_all_samples_make_together(camera, monkeypatch):
    monkeypatch.setattr(response_module, "_ZONE", 4)
    by_zones = Response(camera, [230.0, 250.0], wavelength=None, oversample=1)
    assert not by_zones._recorder.by_samples and len(by_zones.planes[0]._zones) > 1
    init = Recorder.__init__

    def by_samples(recorder, *arguments, **options):
        init(recorder, *arguments, **options)
        recorder.by_samples = True

    monkeypatch.setattr(Recorder, "__init__", by_samples)
    together = Response(camera, [230.0, 250.0], wavelength=None, oversample=1)
    values = np.random.default_rng(0).random(together.source_shape).astype(np.float32)
    image = together.forward(values)
    np.testing.assert_allclose(by_zones.forward(values), image, atol=2e-6 * image.max())
    back = together.adjoint(image)
    np.testing.assert_allclose(by_zones.adjoint(image), back, atol=2e-6 * back.max())


def test_two_bins_along_staggered_lenses_are_as_right_as_six(monkeypatch):
    two = Response(HEXAGONAL, [230.0], wavelength=None, oversample=1)
    assert two.cells.fineness == (2, 6)
    cells = response_module.BinCells
    monkeypatch.setattr(response_module, "BinCells", lambda grid, along, across: cells(grid, 6, across))
    six = Response(HEXAGONAL, [230.0], wavelength=None, oversample=1)
    values = np.random.default_rng(0).random(six.source_shape).astype(np.float32)
    image = six.forward(values)
    # The rays differ; with 1 or 3 bins it is 0.044 or 0.0042.
    assert np.sqrt(((two.forward(values) - image) ** 2).mean()) < 0.003 * image.max()


def test_one_kernel_serves_all_lenses_behind_an_objective(monkeypatch):
    """It is that which each zone would compute for itself, and zones still share the work."""
    monkeypatch.setattr(response_module, "_ZONE", 4)
    camera = mp.PlenopticCamera(
        main_lens=mp.Objective(20, 0.5), mla_pitch=0.075, mla_focal_length=1.5, detector_width=0.45, resolution=(60, 60)
    )
    options = {"wavelength": 550.0, "oversample": 1}
    shared = Response(camera, [0.014], **options)
    assert len({id(zone.blocks) for zone in shared.planes[0]._zones}) == 1 < len(shared.planes[0]._zones)
    monkeypatch.setattr(Response, "_unlike", lambda *_: np.inf)
    own = Response(camera, [0.014], **options)
    assert len({id(zone.blocks) for zone in own.planes[0]._zones}) == len(own.planes[0]._zones) > 1
    values = np.random.default_rng(0).random(shared.source_shape).astype(np.float32)
    image = own.forward(values)
    np.testing.assert_allclose(shared.forward(values), image, atol=2e-3 * image.max())


def test_few_fields_of_a_wide_blur_are_in_memory_at_once():
    """Many points stand for a bin that is far out of focus, and each field covers many lenses."""
    camera = mp.PlenopticCamera.matched(
        f_number=2.8, lenses=20, pixels_per_lens=10, pixel_size=0.005, focal_length=50, focus_distance=320,
        mla_lattice="hexagonal",
    )  # fmt: skip
    samples = []

    class Watched(Threads):
        def __call__(self, batches):
            for batch in batches:
                samples.append(batch.samples)
                if len(samples) == 3:
                    raise StoppedError

    image = np.ones(camera.shape, np.float32)
    with pytest.raises(StoppedError):
        mp.reconstruct(image, 500, camera=camera, method="deconvolved", wavelength=550, batch_map=Watched(1))
    # On the array, fields have more samples than at the detector.
    assert max(samples) * 8 * 1.5**2 <= 2**27


def test_reconstruct_deconvolved(tmp_path, run, complaint):
    raw, out, stack = (tmp_path / name for name in ("raw.exr", "out.exr", "out.tif"))
    mp.write_capture(raw, mp.Capture(white_image(TINY), TINY))
    options = "--method", "deconvolved", "--distance", 253, "--oversample", 2
    kept = tmp_path / "out.exr.checkpoint"
    kept.write_bytes(b"")
    assert "not a checkpoint of this version" in complaint("reconstruct", raw, "-o", out, *options, "--resume")
    told = run("reconstruct", raw, "-o", out, *options, "--iterations", 3)
    assert not kept.exists()
    assert "8 x 8 bins" in told
    assert "3 iterations, as many as were to be made" in told
    with OpenEXR.File(str(out)) as file:
        made = json.loads(file.header()["mitsuba_plenoptic"])
        image = file.channels()["Y"].pixels
    # A capture by rays is deconvolved by rays; white is white, at the borders too.
    assert made["options"]["response"] == "ray"
    np.testing.assert_allclose(image, 1, atol=0.06)
    assert "stopped by the noise" in run("reconstruct", raw, "-o", out, *options, "--photons", 50)
    for wrong, words in ((("--photons", -1), "photons = -1"), (("--response", "wave"), "wavelength")):
        assert words in complaint("reconstruct", raw, "-o", out, *options, *wrong)
    planes = [word for distance in (226, 253, 280) for word in ("--distance", distance)]
    volume = "--method", "deconvolved", "--iterations", 2, "--volume", "--variation", 0.01
    assert f"{stack}: volume of" in run("reconstruct", raw, "-o", stack, *volume, *planes)
    assert tifffile.imread(stack).shape[0] == 3
    assert "deconvolution does not help" in run("info", "paper", "--wavelength", "633")
