"""Parameter sweeps: every point is what its own command gives, kept, labelled, and refused when it makes no sense."""

import os
import sys
import weakref
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from cameras import SMALL_SENSOR, definitions, letters, write_scene
from stopped_runs import StoppedError, start_command, stopped_before

from mitsuba_plenoptic import Cluster, InputError, load_scene, reconstruct, render_capture
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
    """Tell which stages were computed, and which were there."""
    stages = {}

    def finished(name, _, kept):
        stages[name.partition(", ")[0]] = "kept" if kept else "made"

    return stages, StageOptions(finished=finished)


@pytest.mark.slow
def test_every_point_is_what_its_own_rendering_gives(tmp_path):
    grid = {"aperture_radius": [4, 5], "wavelength": [500.0, 633.0], "distance": [210, 240, 280]}
    with sweep(WAVES, grid, tmp_path / "out.nc") as data:
        assert data.capture.dims == ("aperture_radius", "wavelength", "row", "column")
        assert data.capture.shape == (2, 2, 128, 128)
        assert data.reconstruction.dims == ("aperture_radius", "wavelength", "distance", "bin_row", "bin_column")
        assert data.reconstruction.shape == (2, 2, 3, 4, 4)
        assert data.wavelength.attrs["units"] == "nm"
        assert {data[name].attrs["units"] for name in ("distance", "aperture_radius", "bin_size")} == {"mm"}
        for radius in (4, 5):
            scene = load_scene("letters", parameters=TINY | {"aperture_radius": str(radius)})
            for wavelength in (500, 633):
                capture = render_capture(scene, model="wave", method="signed_rays", spp=1, wavelength=wavelength)
                point = data.sel(aperture_radius=radius, wavelength=wavelength)
                np.testing.assert_array_equal(point.capture, capture.image)
                assert float(point.pixel_size) == pytest.approx(capture.camera.pixel_size)
                for result in reconstruct(capture, [210, 240, 280], method="ray"):
                    found = point.sel(distance=result.distance)
                    np.testing.assert_array_equal(found.reconstruction, result.image)
                    assert float(found.bin_size) == pytest.approx(result.bin_size)
        assert data.capture.dtype == np.float32 and data.capture.any()


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
    other = CaptureSpec("letters", parameters=TINY, spp=3)
    sweep(other, {"aperture_radius": [5]}, output, stages=options).close()
    assert stages["capture,aperture_radius=5"] == "made"


@pytest.mark.slow
def test_a_sweep_that_was_stopped_goes_on_in_the_midst_of_a_capture(tmp_path, computed, monkeypatch):
    # Blocks of the detector are kept one by one.
    monkeypatch.setattr(signed_rays, "_BLOCK_BYTES", 2**19)
    stages, options = computed
    grid = {"wavelength": [500, 633]}
    with sweep(WAVES, grid, tmp_path / "clean.nc") as data:
        clean = data.capture.values
    output, second = tmp_path / "out.nc", tmp_path / "out.points" / "capture,wavelength=633.checkpoint"
    output.write_bytes(b"yesterday's")
    with pytest.raises(StoppedError), stopped_before(lambda _: second.exists()):
        sweep(WAVES, grid, output, stages=options)
    assert output.read_bytes() == b"yesterday's"
    assert stages == {"capture,wavelength=500": "made"}
    progress = []
    again = replace(options, resume=True, notify=lambda *told: progress.append(told))
    with sweep(WAVES, grid, output, stages=again) as data:
        np.testing.assert_array_equal(data.capture, clean)
    # The second of two captures of equal work goes on.
    fractions = [done / total for name, done, total in progress if name == "capture,wavelength=633, 2 of 2"]
    assert fractions[0] == 0.5 < fractions[1]
    assert fractions == sorted(fractions) and fractions[-1] == 1
    assert stages == {"capture,wavelength=500": "kept", "capture,wavelength=633": "made"}
    captures = {"capture,wavelength=500.exr", "capture,wavelength=633.exr"}
    assert {path.name for path in (tmp_path / "out.points").iterdir()} == captures | {
        f".{name}.key" for name in captures
    }


def test_a_hexagonal_sweep_has_bins_and_not_lenses(tmp_path):
    settings = CaptureSpec("letters", parameters={**TINY, "mla_lattice": "hexagonal"}, spp=2)
    with sweep(settings, {"aperture_radius": [4, 5], "distance": [240, 280]}, tmp_path / "out.nc") as data:
        camera = load_scene("letters", parameters=settings.parameters).sensors()[0].camera
        assert camera.lens_count != camera.bin_count
        assert (data.sizes["bin_column"], data.sizes["bin_row"]) == camera.bin_count


def test_colours_have_channels(tmp_path):
    scene = write_scene(tmp_path, sensor=SMALL_SENSOR, pixel_format="rgb")
    settings = CaptureSpec(str(scene), spp=1, variant="llvm_ad_rgb")
    with sweep(settings, {"distance": [240, 280]}, tmp_path / "out.nc") as data:
        assert data.capture.dims == ("row", "column", "channel")
        assert data.reconstruction.dims == ("distance", "bin_row", "bin_column", "channel")
        assert data.capture.any()


def test_the_command_takes_yaml_and_words(tmp_path, capsys):
    grid = tmp_path / "grid.yaml"
    grid.write_text("aperture_radius: [4, 5.0]\ndistance: 240  # one\n")
    output = tmp_path / "out.nc"
    assert main([*SWEEP, "-o", str(output), "--grid", str(grid), "--vary", "mla_distance=119,120"]) == 0
    assert "capture, reconstruction over 2 aperture_radius x 1 distance x 2 mla_distance" in capsys.readouterr().out
    with xr.open_dataset(output, engine="h5netcdf") as data:
        assert data.reconstruction.shape == (2, 2, 1, 4, 4)
        assert not np.array_equal(data.capture.sel(mla_distance=119), data.capture.sel(mla_distance=120))


def test_cameras_of_data_sheets_vary_before_any_scene(tmp_path, capfd):
    """In an even world matched cameras read pi / 4 at any f-number, and others the pupil's area."""
    scene = tmp_path / "wall.xml"
    scene.write_text(
        '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"/><emitter type="constant"/></scene>'
    )
    camera = "f_number=4,lenses=8,pixels_per_lens=10,pixel_size=0.005,focal_length=50,focus_distance=320"
    words = ["sweep", str(scene), "-o", str(tmp_path / "s.nc"), "--spp", "16", "--camera", camera]
    for vary, expected in (("f_number=2,4", [np.pi / 4] * 2), ("aperture_radius=3.125,6.25", [np.pi / 16, np.pi / 4])):
        assert main([*words, "--vary", vary]) == 0
        with xr.open_dataset(tmp_path / "s.nc", engine="h5netcdf") as made:
            assert made.capture.mean(("row", "column")).values == pytest.approx(expected, rel=0.01)
    assert main([*words, "--vary", "aperture_radius=3", "--vary", "f_number=4"]) == 2
    assert "it follows from f_number and focal_length" in capfd.readouterr().err


def test_the_dataset_does_not_grow_in_memory(tmp_path, monkeypatch):
    """Only one point's images are held at a time."""
    held = []
    put = sweeps.SweepFile.put

    def watched(layout, index, capture, images):
        held.append(weakref.ref(capture))
        put(layout, index, capture, images)
        assert sum(reference() is not None for reference in held) <= 2

    monkeypatch.setattr(sweeps.SweepFile, "put", watched)
    sweep(RAYS, {"aperture_radius": [2, 3, 4, 5]}, tmp_path / "out.nc").close()
    assert len(held) == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "grid: it is empty; give at least one name with values"),
        (["--vary", "aperture_radius"], "--vary aperture_radius: write it as --vary NAME=VALUE,VALUE,..."),
        (["--vary", "aperture_radius="], "grid: aperture_radius has no values"),
        (["--vary", "aperture_radius=4,wide"], "grid: aperture_radius = 'wide': it must be a number"),
        (["--vary", "aperture_radius=4,nan"], "grid: aperture_radius = nan: it must be finite"),
        (["--vary", "aperture_radius=4,4.0"], "grid: aperture_radius = 4 is given twice"),
        (["--vary", "distance=240", "--vary", "distance=250"], "grid: distance is given twice"),
        (["--vary", "apperture=4"], "parameter apperture: the scene"),
        (["--vary", "../x=4"], "grid: '../x' is not a name"),
        (["--vary", "aperture_radius=4,-5"], "aperture_radius = -5: it must be greater than 0"),
        (["--vary", "distance=240,60"], "distance = 60: it must be greater than the focal length 80"),
        (["--vary", "wavelength=500"], "--wavelength: a ray capture does not take it"),
        (["--vary", "wavelength=500,-1", "--model", "wave"], "wavelength = -1: it must be greater than 0"),
        (["--vary", "distance=240", "--method", "magic"], "method = 'magic': it must be one of"),
        (["--vary", "letter_scale=1,2"], "grid: letter_scale varies and is set by -D too"),
        (["--vary", f"distance={MANY}", "--vary", f"mla_distance={MANY}"], "grid: it has 1000000 points; at most"),
        (["--grid", "none.yaml"], "none.yaml: there is no such file"),
        (["--vary", "aperture_radius=3,4", "--method", "ray"], "--method: nothing is refocused"),
        (["--vary", "aperture_radius=3,4", "--resume"], "--resume: a ray capture does not take it"),
        (["--vary", "aperture_radius=3,4", "--workers", "2"],
         "--workers: a ray capture does not take it; it is for --model wave"),
        (["--vary", "aperture_radios=3,4"], "did you mean aperture_radius?"),
    ],
)  # fmt: skip
def test_a_bad_grid_is_refused_before_the_work(tmp_path, monkeypatch, complaint, words, message):
    def started(*_, **__):
        raise AssertionError("workers were started")

    monkeypatch.setattr("mitsuba_plenoptic.runtime.batches.Cluster.__enter__", started)
    monkeypatch.chdir(tmp_path)
    assert message in complaint(*SWEEP, "-o", "out.nc", *words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it must hold names"),
        ("- 1\n- 2\n", "it must hold names"),
        ("a: [1\n", "it is not YAML"),
        ("a: [[1, 2]]\n", "a holds a list: it must be a number"),
        ("a: {b: 1}\n", "a holds a dict: it must be a number"),
        ("a: 1\na: 2\n", "a is given twice"),
        ("1: 2\n", "1 is not a name"),
        ("a: !!python/object/apply:os.system ['touch trap']\n", "it is not YAML: could not determine a constructor"),
        ("a: " + "[" * 5000 + "]" * 5000, "it is not YAML"),
        ("a: [" + "1, " * 600_000 + "1]", "bytes: it may have at most 65536"),
    ],
)
def test_bad_yaml_is_refused(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "grid.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        check_grid(stated_grid(path, []))
    assert message in str(caught.value) and len(str(caught.value)) < 500 and "\n" not in str(caught.value)
    assert os.listdir() == ["grid.yaml"]  # noqa: PTH208


def test_numbers_of_yaml_are_taken_as_people_mean_them(tmp_path):
    """PyYAML reads YAML 1.1, where 1e3 is text and 010 is 8."""
    path = tmp_path / "grid.yaml"
    path.write_text("a: [1e3, 2.5, 010]\n")
    assert check_grid(stated_grid(path, [])) == {"a": (1000.0, 2.5, 10.0)}
    assert check_grid(stated_grid(None, ["a=1e3, 2.5"])) == {"a": (1000.0, 2.5)}


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5netcdf", None)
    with pytest.raises(InputError, match="pip install h5netcdf h5py"):
        sweep(RAYS, {"distance": [240]}, tmp_path / "out.nc")
    with pytest.raises(InputError, match=r"out.png: give a name that ends in .nc"):
        monkeypatch.undo()
        sweep(RAYS, {"distance": [240]}, tmp_path / "out.png")


@pytest.mark.slow
def test_a_full_disk_leaves_what_was_there(tmp_path):
    """Here a limit on the size of files stands in for it; HDF5 left alone crashes at the end of the process."""
    words = [*SWEEP, "-o", str(tmp_path / "out.nc"), "--vary", "aperture_radius=4,5"]
    assert main(words) == 0
    before = (tmp_path / "out.nc").read_bytes()
    run = start_command(*words, limit=len(before) // 2)
    _, errors = run.communicate(timeout=300)
    assert run.returncode == 2, errors
    assert errors.splitlines()[-1].endswith("out.nc: it cannot be written: File too large")
    assert "Traceback" not in errors and "reused" in errors
    assert (tmp_path / "out.nc").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.nc", "out.points"]


@pytest.mark.slow
def test_a_sweep_on_workers_has_the_same_bits(tmp_path):
    pytest.importorskip("distributed")
    grid = {"wavelength": [500, 633]}
    alone = sweep(WAVES, grid, tmp_path / "alone.nc").load()
    assert alone.capture.any()
    with Cluster(workers=2) as cluster:
        assert sweep(WAVES, grid, tmp_path / "shared.nc", batch_map=cluster).load().equals(alone)
