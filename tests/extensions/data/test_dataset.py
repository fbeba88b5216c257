"""Data sets: the same bits however they were made, and what is read of them."""

import json
import pickle
import shutil
import signal
import subprocess
import sys
import time
import weakref
from importlib.metadata import version

import h5py
import mitsuba as mi
import numpy as np
import pytest
import yaml
from dataset_cases import SMALL, small
from refusals import refuses
from stopped_runs import start_command

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.dataset import DataSet, make_dataset, make_sample, parse_recipe
from mitsuba_plenoptic.extensions.data import dataset_production as production
from mitsuba_plenoptic.extensions.data import shards


def files(folder):
    """All files of a data set with their bytes."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    mi.set_variant("llvm_ad_mono")
    folder = tmp_path_factory.mktemp("data") / "whole"
    make_dataset(parse_recipe(small()), folder)
    return folder


class KilledError(Exception):
    """Stands in for the end of a process."""


def test_a_run_that_was_stopped_or_grew_ends_with_the_same_bits(made, tmp_path, monkeypatch):
    # Stopped before and after each of its writes, in turn; then the count grows.
    write, writes = production.write_samples, []

    def stopping(path, samples):
        writes.append(path)
        if len(writes) in (2, 5):
            (path.parent / f".{path.name}.half").mkdir()
            raise KilledError
        write(path, samples)
        if len(writes) in (4, 7):
            raise KilledError

    monkeypatch.setattr(production, "write_samples", stopping)
    folder, stops = tmp_path / "stopped", 0
    for count in (1, 3, 5, 5, 5, 5, 5):
        try:
            make_dataset(parse_recipe(small(count=count)), folder)
        except KilledError:
            stops += 1
    assert stops == 4
    # The recipe's own count stands in manifest and card as it was last given.
    assert files(folder) == files(made)


def test_samples_hold_what_the_library_itself_makes(made):
    sample = DataSet(made)[1]
    assert json.loads(json.dumps(make_sample(parse_recipe(small()), 1).facts)) == sample.facts
    assert set(sample.arrays) == {"ray", "ray_exposed", "depth", "normal", "views_depth", "views_normal"}
    capture = sample.capture("ray")
    assert capture.camera.shape == (64, 64)
    again = mp.expose(capture, mp.Detector(), photons=sample.facts["draws"]["noise"]["photons"],
                      seed=sample.facts["captures"]["ray_exposed"]["metadata"]["exposure"]["seed"])  # fmt: skip
    np.testing.assert_array_equal(again.image, sample.capture("ray", exposed=True).image)
    lf = mp.decode(capture, truth=sample.truth)
    np.testing.assert_array_equal(lf.depth.values, sample.arrays["views_depth"])
    assert np.nanmin(sample.arrays["depth"]) > 100


def test_a_scene_file_is_captured_as_by_the_command(made):
    recipe = parse_recipe(small())
    index = next(index for index in range(5) if recipe.plan(index).source == 1)
    sample = DataSet(made, ["ray"])[index]
    scene = mp.with_camera(
        mp.load_scene("white", parameters={"resolution": "64", "detector_width": "2.048"}), sample.camera
    )
    seed = sample.facts["captures"]["ray"]["metadata"]["seed"]
    capture = mp.render_capture(scene, model="ray", spp=2, seed=seed)
    np.testing.assert_array_equal(capture.image, sample.arrays["ray"])


def test_slices_are_samples_and_a_renamed_recipe_is_the_same(made, tmp_path):
    samples = DataSet(made)
    assert [one.facts for one in samples[0:2]] == [samples[0].facts, samples[1].facts]
    copy = shutil.copytree(made, tmp_path / "copy")
    make_dataset(parse_recipe(small(name="renamed")), copy)


def test_another_recipe_is_refused_with_the_difference(made, tmp_path):
    for changes, message in (
        ({"seed": 4}, "it holds other samples: recipe.seed = 3 there, 4 here; choose another folder"),
        ({"count": 4}, r"count = 4: .* holds 5 samples; it may only grow"),
    ):
        refuses(message, make_dataset, parse_recipe(small(**changes)), made)
    (tmp_path / "mine.txt").write_text("mine")
    refuses("it holds something else", make_dataset, parse_recipe(small()), tmp_path)


def flipped(path, index, array):
    """Change one bit in the middle of an array of a sample, as a failing disk does."""
    with h5py.File(path, "r") as file:
        chunk = file[f"{index:06d}/{array}"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("array", ["ray", "facts"])
def test_a_damaged_sample_is_refused_and_others_are_read(made, tmp_path, array):
    folder = shutil.copytree(made, tmp_path / "copy")
    flipped(folder / "shards/shard-00000.h5", 1, array)
    with pytest.raises(InputError, match=r"shard-00000\.h5: sample 1 is damaged: "):
        DataSet(folder)[1]
    assert DataSet(folder)[0].facts == DataSet(made)[0].facts
    if array == "ray":
        assert DataSet(folder, ["depth"])[1].arrays["depth"].shape == (64, 64)


@pytest.mark.parametrize("damage", [lambda path: path.write_bytes(path.read_bytes()[:100]), lambda path: path.unlink()])
def test_a_rerun_makes_shards_again_that_are_not_there_or_cut_off(made, tmp_path, damage, caplog):
    folder = shutil.copytree(made, tmp_path / "copy")
    damage(folder / "shards/shard-00001.h5")
    with pytest.raises(InputError, match=r"shard-00001\.h5: it is (damaged|missing)"):
        DataSet(folder)[2]
    make_dataset(parse_recipe(small()), folder)
    assert files(folder) == files(made)


@pytest.mark.parametrize("where", [(), ("software",)])
def test_other_software_does_not_continue_a_data_set(made, tmp_path, complaint, where):
    recipe, folder = tmp_path / "recipe.yaml", shutil.copytree(made, tmp_path / "old")
    recipe.write_text(yaml.safe_dump(small()))
    manifest = json.loads((folder / "dataset.json").read_text())
    assert manifest["version"] == DataSet(folder)[0].facts["version"] == version("mitsuba-plenoptic")
    changed, name = (manifest["software"], "mitsuba_plenoptic") if where else (manifest, "version")
    changed[name] = "1.0"
    (folder / "dataset.json").write_text(json.dumps(manifest))
    before = files(folder)
    said = complaint("dataset", recipe, "-o", folder)
    assert f"old: it holds other samples: {'.'.join((*where, name))} = 1.0 there" in said
    assert files(folder) == before


def test_a_run_goes_on_after_a_lock_that_nobody_holds(made, tmp_path):
    def stopped(tasks):
        yield tasks[0].prepare()()
        raise KilledError

    folder = tmp_path / "stopped"
    with pytest.raises(KilledError):
        make_dataset(parse_recipe(small()), folder, batch_map=stopped)
    # A process that was killed leaves its lock file behind, without the lock.
    (folder / ".lock").touch()
    make_dataset(parse_recipe(small()), folder)
    assert files(folder) == files(made)


def test_a_second_process_in_the_folder_is_refused(made, tmp_path, complaint):
    recipe, folder = tmp_path / "recipe.yaml", tmp_path / "data"
    recipe.write_text(yaml.safe_dump(small()))
    found = []

    def meanwhile(tasks):
        # The lock is that of an opened file, so that it keeps this process out as it does others.
        found.append(complaint("dataset", recipe, "-o", folder))
        return (task.prepare()() for task in tasks)

    make_dataset(parse_recipe(small()), folder, batch_map=meanwhile)
    assert found == [f"{folder}: another process is computing this; wait until it has ended"]
    assert files(folder) == files(made)


def test_without_h5py_no_sample_is_rendered(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    monkeypatch.setattr(production, "make_sample", None)
    refuses("a data set needs the package h5py: pip install h5py", make_dataset, parse_recipe(small()), tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_what_is_asked_for_and_not_there_is_named(made):
    samples = DataSet(made)
    for index in (5, np.int64(5)):
        with pytest.raises(IndexError, match=r"^sample 5: there are 5$"):
            samples[index]
    assert samples[-1].index == samples[np.int64(-1)].index == 4 and samples[-5].index == 0
    with pytest.raises(IndexError, match=r"^sample -6: there are 5$"):
        samples[-6]
    for index in ("a", None, 1.0, (0, 1), [0, 1], [], np.array([0, 1]), np.array([0]), np.array(1.0), {}):
        with pytest.raises(TypeError, match=r"^sample .* of type \w+: give a whole number, or a slice$"):
            samples[index]
    assert samples[np.int64(3)].index == samples[np.array(3)].index == 3
    with pytest.raises(InputError, match="sample 0: it has no wave; it has depth, facts"):
        DataSet(made, ["wave"])[0]
    assert [sample.index for sample in pickle.loads(pickle.dumps(DataSet(made, ["ray"])))] == [0, 1, 2, 3, 4]
    with pytest.raises(InputError, match=r"^missing: .*there is no such (file|folder)"):
        DataSet("missing")


def test_the_preview_names_samples_and_pictures(made, monkeypatch):
    plots = []
    monkeypatch.setattr(production.plots.Plot, "save", lambda plot, path: plots.append(plot))
    production.write_preview(made / "preview.png", DataSet(made))
    rows = [plots[0].axes[row : row + 3] for row in range(0, 15, 3)]
    assert [axes.get_title("left") for axes in rows[0]] == ["ray", "ray exposed", "depth, near in white"]
    assert [row[0].get_ylabel() for row in rows] == [f"sample {index}" for index in range(5)]


def test_few_files_are_open_at_once(made, monkeypatch):
    opened, open_shard = [], shards.open_shard

    def noting(path):
        file = open_shard(path)
        opened.append(weakref.ref(file))
        return file

    monkeypatch.setattr(shards, "_MOST_OPEN", 1)
    monkeypatch.setattr(shards, "open_shard", noting)
    samples = DataSet(made, ["ray"])
    assert [samples[index].index for index in (0, 2, 4, 3, 1)] == [0, 2, 4, 3, 1]
    assert [each() is not None for each in opened] == [False] * 4 + [True]


def test_pytorch_reads_tensors(made):
    torch = pytest.importorskip("torch")
    from mitsuba_plenoptic.extensions.data.torch_data import TorchDataset

    loader = torch.utils.data.DataLoader(TorchDataset(made, ["ray", "normal"]), batch_size=5)
    (batch,) = loader
    with pytest.raises(TypeError, match=r"^sample slice\(0, 2, None\): give a whole number"):
        loader.dataset[0:2]
    assert batch["ray"].shape == (5, 64, 64)
    assert batch["normal"].shape == (5, 3, 64, 64)
    expected = np.moveaxis(DataSet(made)[3].arrays["normal"], -1, 0)
    np.testing.assert_array_equal(batch["normal"][3].numpy(), expected)


def test_ctrl_c_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    def stopped(recipe, folder, *, batch_map, progress):
        progress(2, 5)
        raise KeyboardInterrupt

    monkeypatch.setattr(mp.dataset, "make_dataset", stopped)
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(yaml.safe_dump(small()))
    assert main(["dataset", str(recipe), "-o", str(tmp_path / "data")]) == 130
    assert "stopped at 40 %: the same command goes on from there" in capsys.readouterr().err


@pytest.mark.slow
def test_killed_processes_on_workers_end_with_the_bits_of_one_process(tmp_path):
    # Pairs of captures by rays and by waves, of a small aperture, so that waves are quick.
    camera = {**small()["camera"], "aperture_radius": 1}
    scenes = [{"generator": "shapes", "objects": 4, "near": 225, "far": 260}]
    content = small(models=["ray", "wave"], wave={"spp": 1}, camera=camera, scenes=scenes)
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(yaml.safe_dump(content))

    def start(folder, *options):
        words = ["-m", "mitsuba_plenoptic", "dataset", recipe, "-o", tmp_path / folder, *options]
        return subprocess.Popen([sys.executable, *map(str, words)], stdout=subprocess.DEVNULL)

    assert start("whole").wait() == 0
    for kept in (1, 3):
        process = start("killed", "--workers", "1")
        while process.poll() is None and len(list((tmp_path / "killed").rglob("*.h5"))) < kept:
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert start("killed", "--workers", "1").wait() == 0
    assert files(tmp_path / "killed") == files(tmp_path / "whole")


def test_a_full_disk_leaves_finished_shards_and_a_rerun_goes_on(tmp_path):
    """Here a limit on the size of files stands in for it; HDF5 left alone crashes at the end of the process."""
    recipe, folder = tmp_path / "small.yaml", tmp_path / "made"
    content = small(scenes=SMALL["scenes"][:1])
    recipe.write_text(json.dumps(content | {"count": 2}))
    assert main(["dataset", str(recipe), "-o", str(folder)]) == 0
    first = (folder / "shards" / "shard-00000.h5").read_bytes()
    recipe.write_text(json.dumps(content))
    # Samples fit, the two of a shard do not.
    run = start_command("dataset", recipe, "-o", folder, limit=len(first) * 3 // 4)
    _, errors = run.communicate(timeout=300)
    assert run.returncode == 2, errors
    assert errors.splitlines()[-1].endswith("shard-00001.h5: it cannot be written: File too large")
    assert "Traceback" not in errors
    shards = [path.name for path in (folder / "shards").iterdir()]
    assert shards == ["shard-00000.h5"] and (folder / "shards" / shards[0]).read_bytes() == first
    assert sorted(path.name for path in (folder / "samples").iterdir()) == ["000002.h5", "000003.h5"]
    assert main(["dataset", str(recipe), "-o", str(folder)]) == 0
    assert [sample.index for sample in DataSet(folder)] == [0, 1, 2, 3, 4]
    assert (folder / "shards" / shards[0]).read_bytes() == first
