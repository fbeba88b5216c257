"""Data sets: the same bits however they were made, and what is read of them."""

import json
import pickle
import re
import shutil
import sys
from importlib.metadata import version

import h5py
import mitsuba as mi
import numpy as np
import pytest
import yaml
from dataset_cases import small
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.dataset import DataSet, make_dataset, make_sample, parse_recipe
from mitsuba_plenoptic.extensions.data import dataset_production as production


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module", autouse=True)
def no_figures():
    """Write previews as text, as drawing one takes longer than rendering all samples."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(production, "write_preview", lambda path, samples: path.write_text(f"{len(samples)} samples"))
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "whole"
    make_dataset(parse_recipe(small()), folder)
    return folder


def test_a_run_that_was_stopped_or_grew_ends_with_the_same_bits(made, tmp_path, monkeypatch):
    """Stopped before and after each of its writes, in turn, with a lock that nobody holds; then the count grows."""
    write, writes = production.write_samples, []

    def stopping(path, samples):
        writes.append(path)
        if len(writes) in (2, 5):
            (path.parent / f".{path.name}.half").mkdir()
            (path.parent / f".{path.name}.half" / path.name).touch()
            raise KeyboardInterrupt
        write(path, samples)
        if len(writes) in (4, 7):
            raise KeyboardInterrupt

    monkeypatch.setattr(production, "write_samples", stopping)
    folder, stops = tmp_path / "stopped", 0
    for count in (1, 3, 5, 5, 5, 5, 5):
        try:
            make_dataset(parse_recipe(small(count=count)), folder)
        except KeyboardInterrupt:
            stops += 1
            (folder / ".lock").touch()
    assert stops == 4
    assert files(folder) == files(made)


def test_samples_hold_what_the_library_itself_makes(made):
    sample, recipe = DataSet(made)[1], parse_recipe(small())
    # Whichever variant is active before.
    mi.set_variant("llvm_ad_rgb")
    again = make_sample(recipe, 1)
    assert json.loads(json.dumps(again.facts)) == sample.facts
    np.testing.assert_array_equal(again.arrays["ray"], sample.arrays["ray"])
    assert set(sample.arrays) == {"ray", "ray_exposed", "depth", "normal", "views_depth", "views_normal"}
    capture, record = sample.capture("ray"), sample.facts["captures"]["ray_exposed"]["metadata"]["exposure"]
    again = mp.expose(capture, mp.Detector(), photons=sample.facts["draws"]["noise"]["photons"], seed=record["seed"])
    np.testing.assert_array_equal(again.image, sample.capture("ray", exposed=True).image)
    np.testing.assert_array_equal(mp.decode(capture, truth=sample.truth).depth.values, sample.arrays["views_depth"])
    assert np.nanmin(sample.arrays["depth"]) > 100
    # One of a scene file.
    sample = DataSet(made, ["ray"])[next(index for index in range(5) if recipe.plan(index).source == 1)]
    scene = mp.load_scene("white", parameters={"resolution": "64", "detector_width": "2.048"})
    seed = sample.facts["captures"]["ray"]["metadata"]["seed"]
    capture = mp.render_capture(mp.with_camera(scene, sample.camera), model="ray", spp=2, seed=seed)
    np.testing.assert_array_equal(capture.image, sample.arrays["ray"])


def test_another_recipe_is_refused_with_the_difference(made, tmp_path):
    for changes, message in (({"seed": 4}, "recipe.seed = 3 there, 4 here"), ({"count": 4}, "count = 4: .* 5 samples")):
        refuses(message, make_dataset, parse_recipe(small(**changes)), made)
    make_dataset(parse_recipe(small(name="renamed")), shutil.copytree(made, tmp_path / "copy"))
    refuses("something else", make_dataset, parse_recipe(small()), tmp_path)


@pytest.mark.parametrize("array", ["ray", "facts"])
def test_a_damaged_sample_is_refused_and_others_are_read(made, tmp_path, array):
    """One bit in the middle of an array changes, as by a failing disk."""
    folder = shutil.copytree(made, tmp_path / "copy")
    path = folder / "shards/shard-00000.h5"
    with h5py.File(path, "r") as file:
        chunk = file[f"000001/{array}"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"shard-00000\.h5: sample 1 is damaged: "):
        DataSet(folder)[1]
    assert DataSet(folder)[0].facts == DataSet(made)[0].facts
    if array == "ray":
        assert DataSet(folder, ["depth"])[1].arrays["depth"].shape == (64, 64)


@pytest.mark.parametrize("damage", [lambda path: path.write_bytes(path.read_bytes()[:100]), lambda path: path.unlink()])
def test_a_rerun_makes_shards_again_that_are_not_there_or_cut_off(made, tmp_path, damage):
    folder = shutil.copytree(made, tmp_path / "copy")
    damage(folder / "shards/shard-00001.h5")
    with pytest.raises(InputError, match=r"shard-00001\.h5: it is (damaged|missing)"):
        DataSet(folder)[2]
    make_dataset(parse_recipe(small()), folder)
    assert files(folder) == files(made)


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "recipe.yaml"
    path.write_text(yaml.safe_dump(small()))
    return path


def test_other_software_does_not_continue_a_data_set(made, recipe, tmp_path, complaint):
    folder = shutil.copytree(made, tmp_path / "old")
    manifest = json.loads((folder / "dataset.json").read_text())
    assert manifest["version"] == DataSet(folder)[0].facts["version"] == version("mitsuba-plenoptic")
    manifest["software"]["mitsuba_plenoptic"] = "1.0"
    (folder / "dataset.json").write_text(json.dumps(manifest))
    before = files(folder)
    message = "old: it holds other samples: software.mitsuba_plenoptic = 1.0 there"
    assert message in complaint("dataset", recipe, "-o", folder)
    assert files(folder) == before


def test_a_second_process_in_the_folder_is_refused(made, recipe, tmp_path, complaint):
    folder, found = tmp_path / "data", []

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
    refuses("pip install h5py", make_dataset, parse_recipe(small()), tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_what_is_asked_for_and_not_there_is_named(made):
    samples = DataSet(made)
    assert [one.facts for one in samples[0:2]] == [samples[0].facts, samples[1].facts]
    assert samples[-1].index == samples[np.int64(-1)].index == 4 and samples[np.array(3)].index == 3
    for index in (5, np.int64(5), -6):
        with pytest.raises(IndexError, match=f"sample {index}: there are 5"):
            samples[index]
    for index in ("a", None, 1.0, (0, 1), [], np.array([0]), np.array(1.0), {}):
        with pytest.raises(TypeError, match=r"^sample .* of type \w+: "):
            samples[index]
    refuses("sample 0: it has no wave; it has depth, facts", lambda: DataSet(made, ["wave"])[0])
    assert [sample.index for sample in pickle.loads(pickle.dumps(DataSet(made, ["ray"])))] == [0, 1, 2, 3, 4]
    refuses("^missing: ", DataSet, "missing")


def test_pytorch_reads_tensors(made, monkeypatch):
    torch = pytest.importorskip("torch")
    from mitsuba_plenoptic.extensions.data.torch_data import TorchDataset

    loader = torch.utils.data.DataLoader(TorchDataset(made, ["ray", "normal"]), batch_size=5)
    (batch,) = loader
    with pytest.raises(TypeError, match="slice"):
        loader.dataset[0:2]
    assert batch["ray"].shape == (5, 64, 64)
    assert batch["normal"].shape == (5, 3, 64, 64)
    monkeypatch.chdir(made)
    exec(re.search("```python\n(.*?)```", (made / "README.md").read_text(), re.DOTALL)[1], {})
    np.testing.assert_array_equal(batch["normal"][3].numpy(), np.moveaxis(DataSet(made)[3].arrays["normal"], -1, 0))


def test_ctrl_c_says_how_to_go_on(recipe, tmp_path, monkeypatch, capsys):
    def stopped(recipe, folder, *, batch_map, progress):
        progress(2, 5)
        raise KeyboardInterrupt

    monkeypatch.setattr(mp.dataset, "make_dataset", stopped)
    assert main(["dataset", str(recipe), "-o", str(tmp_path / "data")]) == 130
    assert "stopped at 40 %: the same command goes on from there" in capsys.readouterr().err


def test_a_full_disk_leaves_finished_shards(made, tmp_path, python):
    """Here a limit on the size of files stands in for it; HDF5 left alone crashes at the end of the process."""
    folder = shutil.copytree(made, tmp_path / "made")
    before = files(folder)
    run = python(
        """
        import resource, signal, sys
        from mitsuba_plenoptic import InputError
        from mitsuba_plenoptic.extensions.data.shards import DataSet, write_samples

        samples = DataSet(sys.argv[1])
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
        try:
            write_samples(samples.folder / "shards" / "shard-00001.h5", [samples[2], samples[3]])
        except InputError as error:
            print(error)
        """,
        folder,
        (folder / "shards" / "shard-00001.h5").stat().st_size * 3 // 4,
    )
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.endswith("shard-00001.h5: it cannot be written: File too large\n")
    assert files(folder) == before
