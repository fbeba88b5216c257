"""Parameter sweeps: every point is what its own command gives, kept, labelled, and refused when it makes no sense."""

import sys
import weakref
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from cameras import definitions, letters
from refusals import refused, refuses
from stopped_runs import StoppedError, stopped_before

from mitsuba_plenoptic import Cluster, load_scene, render_capture
from mitsuba_plenoptic.capture_spec import CaptureSpec
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.extensions.studio import sweep as sweeps
from mitsuba_plenoptic.extensions.studio.sweep import check_grid, stated_grid, sweep
from mitsuba_plenoptic.io.cache import StageOptions
from mitsuba_plenoptic.waves import signed_rays

pytest.importorskip("h5netcdf")

TINY = letters(4)
RAYS = CaptureSpec("letters", parameters=TINY, spp=2)
WAVES = CaptureSpec("letters", parameters=TINY, model="wave", spp=1)
SWEEP = ["sweep", "letters", "--spp", "1", *definitions(TINY)]
MANY = ",".join(map(str, range(1000)))


@pytest.fixture
def computed():
    stages = {}

    def finished(name, _, kept):
        stages[name.partition(", ")[0]] = "kept" if kept else "made"

    return stages, StageOptions(finished=finished)


def test_finished_points_are_kept_and_a_grown_grid_computes_what_is_missing(tmp_path, computed):
    stages, options = computed
    output = tmp_path / "out.nc"
    sweep(RAYS, {"aperture_radius": [4, 5]}, output, stages=options).close()
    assert list(stages.values()) == ["made", "made"]
    first = output.read_bytes()
    sweep(RAYS, {"aperture_radius": [4, 5]}, output, stages=options).close()
    assert list(stages.values()) == ["kept", "kept"]
    assert output.read_bytes() == first
    with sweep(RAYS, {"aperture_radius": [3, 5], "distance": [240]}, output, stages=options) as data:
        assert [stages[f"capture,aperture_radius={radius}"] for radius in (3, 4, 5)] == ["made", "kept", "kept"]
        assert data.capture.sizes["aperture_radius"] == 2
    sweep(CaptureSpec("letters", parameters=TINY, spp=3), {"aperture_radius": [5]}, output, stages=options).close()
    assert stages["capture,aperture_radius=5"] == "made"


@pytest.mark.slow
def test_a_sweep_that_was_stopped_goes_on_in_the_midst_of_a_capture(tmp_path, computed, monkeypatch):
    # Blocks of the detector are kept one by one.
    monkeypatch.setattr(signed_rays, "_BLOCK_BYTES", 2**19)
    stages, options = computed
    grid, output, second = {"wavelength": [500, 633]}, tmp_path / "out.nc", "capture,wavelength=633"
    with sweep(WAVES, grid, tmp_path / "clean.nc") as data:
        clean = data.capture.values
    output.write_bytes(b"yesterday's")
    with pytest.raises(StoppedError), stopped_before(lambda _: (tmp_path / f"out.points/{second}.checkpoint").exists()):
        sweep(WAVES, grid, output, stages=options)
    assert output.read_bytes() == b"yesterday's"
    assert stages == {"capture,wavelength=500": "made"}
    progress = []
    again = replace(options, resume=True, notify=lambda *told: progress.append(told))
    with sweep(WAVES, grid, output, stages=again) as data:
        np.testing.assert_array_equal(data.capture, clean)
    # The second of two captures of equal work goes on.
    fractions = [done / total for name, done, total in progress if name == f"{second}, 2 of 2"]
    assert fractions[0] == 0.5 < fractions[1] and fractions == sorted(fractions) and fractions[-1] == 1
    assert stages == {"capture,wavelength=500": "kept", second: "made"}


def test_the_command_takes_yaml_and_words(tmp_path, capsys):
    grid = tmp_path / "grid.yaml"
    grid.write_text("aperture_radius: [4, 5.0]\ndistance: 240  # one\n")
    output = tmp_path / "out.nc"
    assert main([*SWEEP, "-o", str(output), "--grid", str(grid), "--vary", "mla_distance=119,120"]) == 0
    assert "2 aperture_radius x 1 distance x 2 mla_distance" in capsys.readouterr().out
    with xr.open_dataset(output, engine="h5netcdf") as data:
        assert data.reconstruction.shape == (2, 2, 1, 4, 4)
        assert not np.array_equal(data.capture.sel(mla_distance=119), data.capture.sel(mla_distance=120))


def test_the_dataset_does_not_grow_in_memory(tmp_path, monkeypatch):
    held = []
    put = sweeps.SweepFile.put

    def watched(layout, index, capture, images):
        held.append(weakref.ref(capture))
        put(layout, index, capture, images)
        assert sum(reference() is not None for reference in held) <= 2

    monkeypatch.setattr(sweeps.SweepFile, "put", watched)
    sweep(RAYS, {"aperture_radius": [2, 3, 4, 5]}, tmp_path / "out.nc").close()
    assert len(held) == 4


def test_a_bad_grid_is_refused_before_the_work(tmp_path, monkeypatch, complaint):
    monkeypatch.setattr("mitsuba_plenoptic.runtime.batches.Cluster.__enter__", lambda _: pytest.fail("workers started"))
    monkeypatch.chdir(tmp_path)
    for words, message in (
        ("", "grid: it is empty"),
        ("--vary aperture_radius=4,nan", "grid: aperture_radius = nan: "),
        ("--vary aperture_radius=4,4.0", "grid: aperture_radius = 4 is given twice"),
        ("--vary ../x=4", "grid: '../x' is not a name"),
        ("--vary wavelength=500", "--wavelength: a ray capture"),
        ("--vary letter_scale=1,2", "grid: letter_scale varies and is set by -D too"),
        (f"--vary distance={MANY} --vary mla_distance={MANY}", "grid: it has 1000000 points"),
        ("--vary aperture_radius=3,4 --method ray", "--method: nothing is refocused"),
        ("--vary aperture_radios=3,4", "did you mean aperture_radius?"),
    ):
        assert message in complaint(*SWEEP, "-o", "out.nc", *words.split())
    assert list(tmp_path.iterdir()) == []


def of_yaml(folder, text):
    (folder / "grid.yaml").write_text(text)
    return check_grid(stated_grid(folder / "grid.yaml", []))


test_bad_yaml_is_refused = refused(
    (lambda folder: of_yaml(folder, "a: [1\n"), "it is not YAML"),
    (lambda folder: of_yaml(folder, "a: [[1, 2]]\n"), "a holds a list"),
    (lambda folder: of_yaml(folder, "a: 1\na: 2\n"), "a is given twice"),
    (lambda folder: of_yaml(folder, "a: !!python/object/apply:os.system ['touch trap']\n"), "it is not YAML"),
    (lambda folder: of_yaml(folder, "a: " + "[" * 500 + "]" * 500), "it is not YAML"),
    (lambda folder: of_yaml(folder, "a: [" + "1, " * 600_000 + "1]"), "bytes: it may have at most 65536"),
)


def test_numbers_of_yaml_are_taken_as_people_mean_them(tmp_path):
    """PyYAML reads YAML 1.1, where 1e3 is text and 010 is 8."""
    assert of_yaml(tmp_path, "a: [1e3, 2.5, 010]\n") == {"a": (1000.0, 2.5, 10.0)}
    assert check_grid(stated_grid(None, ["a=1e3, 2.5"])) == {"a": (1000.0, 2.5)}


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    refuses("out.png: ", sweep, RAYS, {"distance": [240]}, tmp_path / "out.png")
    monkeypatch.setitem(sys.modules, "h5netcdf", None)
    refuses("pip install h5netcdf", sweep, RAYS, {"distance": [240]}, tmp_path / "out.nc")


@pytest.mark.slow
def test_a_sweep_on_workers_has_the_same_bits(tmp_path):
    pytest.importorskip("distributed")
    grid = {"wavelength": [500, 633]}
    alone = sweep(WAVES, grid, tmp_path / "alone.nc").load()
    scene = load_scene("letters", parameters=TINY)
    capture = render_capture(scene, model="wave", method="signed_rays", spp=1, wavelength=500)
    np.testing.assert_array_equal(alone.capture.sel(wavelength=500), capture.image)
    assert capture.image.any() and alone.wavelength.attrs["units"] == "nm"
    with Cluster(workers=2) as cluster:
        assert sweep(WAVES, grid, tmp_path / "shared.nc", batch_map=cluster).load().equals(alone)
