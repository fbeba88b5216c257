"""Wave captures that are stopped: they go on from their checkpoint, with the bits of one that was not."""

import errno
import io
import json
import os
import pickle
import tempfile
from pathlib import Path
from unittest import mock

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, letters, scattered, small_camera
from stopped_runs import CheckpointStore, StoppedError, stopped_before

from mitsuba_plenoptic import CaptureOperator, Checkpoint, InputError, Job, load_scene, render_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.io import checkpoints
from mitsuba_plenoptic.waves import phase_space, scheme, signed_rays

SMALL = small_camera(4, **HALF)


class Trap:
    """Leaves a mark where it is unpickled."""

    path = Path(tempfile.gettempdir()) / f"unpickled-{os.getpid()}"

    def __reduce__(self):
        return Path.touch, (self.path,)


def render(checkpoint=None, parameters=None, **options):
    """Render the capture by waves, or one a little different from it."""
    scene = load_scene("letters", parameters=letters(4, resolution=64) | (parameters or {}))
    return render_capture(scene, checkpoint=checkpoint, **{"model": "wave", "method": "points", "spp": 16} | options)


def stop_before(path, unwanted, **options):
    """Render until a checkpoint would follow that is not wanted; return how many sums were finished in each."""
    with pytest.raises(StoppedError), stopped_before(unwanted) as sums, Checkpoint(path) as checkpoint:
        render(checkpoint, **options)
    return sums


@pytest.fixture(scope="module")
def clean():
    """Render the capture that no run is allowed to differ from."""
    mi.set_variant("llvm_ad_mono")
    return render().image


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """Stop a capture and return its checkpoint's content."""
    mi.set_variant("llvm_ad_mono")
    path = tmp_path_factory.mktemp("stopped") / "raw.checkpoint"
    stop_before(path, lambda sums: len(sums) == 1)
    return path.read_bytes()


def test_a_sum_goes_on_from_its_middle_and_its_end(count=30):
    operator = CaptureOperator(SMALL, scattered(count, distances=(102, 137), image=0.1), wavelength=633)
    weights = np.random.default_rng(1).uniform(0, 1, (count, 2))
    weights[1] = 0
    keeper = CheckpointStore()
    whole = operator.forward(weights, job=Job(keeper=keeper))
    states = keeper.kept
    assert [state.partial.batches for state in states] == list(range(1, len(states) + 1))
    for state in (states[len(states) // 2], states[-1]):
        calls = []
        job = Job(progress=lambda *call, calls=calls: calls.append(call), keeper=CheckpointStore(state))
        np.testing.assert_array_equal(operator.forward(weights, job=job), whole)
        assert calls[-1] == (count, count) and (len(calls) == 1) == (state is states[-1])


def test_a_capture_goes_on_where_it_was_stopped(tmp_path, clean, count=4):
    path, calls = tmp_path / "raw.exr.checkpoint", []
    stop_before(path, lambda sums: len(sums) == count)
    with pytest.raises(InputError, match=r"raw.exr.checkpoint: the checkpoint of a run that was stopped"):
        Checkpoint(path).__enter__()
    with Checkpoint(path, "resume") as checkpoint:
        image = render(checkpoint, progress=lambda *call: calls.append(call)).image
    assert calls[0][0] > 0
    np.testing.assert_array_equal(image, clean)
    assert not path.exists()


@pytest.mark.slow
def test_finished_sums_are_remembered(tmp_path):
    """Stopped in the third of three sums, one a wavelength."""
    mi.set_variant("llvm_ad_rgb")
    path, options = tmp_path / "checkpoint", {"spp": 4, "seed": 3, "wavelength": "600, 633, 500"}
    sums = stop_before(path, lambda sums: 2 in sums, **options)
    assert sums[0] == 0 and 1 in sums
    with Checkpoint(path, "resume") as checkpoint:
        resumed = render(checkpoint, **options).image
    np.testing.assert_array_equal(resumed, render(**options).image)


@pytest.mark.parametrize(
    ("parameters", "options", "difference"),
    [
        ({"aperture_radius": "4"}, {}, "camera.aperture_radius = 5.0 there, 4.0 here"),
        ({"letter_scale": "0.05"}, {}, "scene_digest = "),
        ({}, {"wavelength": 500}, "wavelength = 633 there, 500 here"),
    ],
)
def test_another_run_is_refused_with_the_difference(tmp_path, stopped, parameters, options, difference):
    said = complaint(tmp_path, stopped, parameters=parameters, **options)
    assert said.startswith(f"{tmp_path / 'raw.checkpoint'}: the checkpoint of another run: ")
    assert difference in said


def rewritten(content, change):
    """Return a checkpoint with a changed header or array."""
    with np.load(io.BytesIO(content)) as archive:
        arrays = dict(archive)
    header = json.loads(str(arrays.pop("header")))
    change(header, arrays)
    buffer = io.BytesIO()
    np.savez(buffer, header=json.dumps(header), **arrays)
    return buffer.getvalue()


@pytest.mark.parametrize(("change", "words"), [
    (lambda header, _: header.update(format=3), "another run: format = 3 there, 1 here"),
    (lambda header, _: header["run"]["software"].update(mitsuba_plenoptic="0123"), "mitsuba_plenoptic = 0123"),
    (lambda header, _: header.update(batches=10**6), "1000000 batches"),
    (lambda _, arrays: arrays.update(image=np.zeros((1, 4, 1), np.float32)), "shape (1, 4, 1)"),
    (lambda _, arrays: arrays.pop("image"), "is damaged"),
    (lambda _, arrays: arrays.update(image=np.array([Trap()], dtype=object)), "is damaged: Object arrays"),
])  # fmt: skip
def test_what_a_checkpoint_says_is_checked(tmp_path, stopped, change, words):
    assert words in complaint(tmp_path, rewritten(stopped, change))
    assert not Trap.path.exists()


def test_other_files_are_refused(tmp_path, stopped):
    damaged = stopped[:999] + bytes([stopped[999] ^ 1]) + stopped[1000:]
    for content, words in ((damaged, "Bad CRC-32"), (pickle.dumps(Trap()), "is not a checkpoint of this version")):
        assert words in complaint(tmp_path, content)
    assert not Trap.path.exists()


def complaint(folder, content, **options):
    """Return the one line about a checkpoint that cannot be resumed, and is left as it is."""
    path = folder / "raw.checkpoint"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught, Checkpoint(path, "resume") as checkpoint:
        render(checkpoint, **options)
    assert path.read_bytes() == content
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_stage_replaces_the_checkpoint_of_another_run_unless_told(tmp_path, stopped, clean, caplog):
    path = tmp_path / "raw.checkpoint"
    path.write_bytes(rewritten(stopped, lambda header, _: header["run"].update(seed=5)))
    caplog.set_level("INFO", "mitsuba_plenoptic")
    with Checkpoint(path, "resume_if_same") as checkpoint:
        image = render(checkpoint).image
    np.testing.assert_array_equal(image, clean)
    assert "seed = 5 there, 0 here; beginning anew" in caplog.text
    assert not path.exists()


def test_checkpoints_take_a_small_fraction_of_the_time(tmp_path, monkeypatch):
    clock, written = [0.0], []
    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: clock[0])

    def write(path, run, snapshot, prepared):
        path.write_bytes(b"")
        clock[0] += 2
        written.append(clock[0])

    monkeypatch.setattr(checkpoints, "_write", write)
    with Checkpoint(tmp_path / "checkpoint") as checkpoint:
        checkpoint.begin((1, 1, 1))
        while clock[0] < 1000:
            clock[0] += 0.5
            checkpoint.save(None)
    assert written[0] == 4.5
    assert 2 * len(written) <= 0.05 * clock[0] + 2
    assert len(written) > 20


def test_a_full_disk_is_named_once(tmp_path, monkeypatch):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(checkpoints, "_write", mock.Mock(side_effect=full))
    path = tmp_path / "raw.checkpoint"
    with Checkpoint(path) as checkpoint:
        checkpoint.begin((1, 1, 1))
        monkeypatch.setattr(checkpoint, "_due", 0.0)
        with pytest.warns(UserWarning) as warned:
            checkpoint.save(None)
    assert str(warned[0].message) == f"{path}: no checkpoint can be written: No space left on device"


def test_a_capture_that_was_killed_keeps_its_kernels(tmp_path, monkeypatch):
    """Those of signed rays; the first state is saved before a second block is traced."""
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    monkeypatch.setattr(signed_rays, "_BLOCK_RAYS", 0)
    monkeypatch.setattr(signed_rays, "_BLOCK_PIXELS", 2**12)
    path, options = tmp_path / "checkpoint", {"method": "signed_rays", "spp": 4}

    def image(existing, progress=None):
        signed_rays._kernels_of.cache_clear()
        scheme.plan_of.cache_clear()
        with Checkpoint(path, existing) as checkpoint:
            return render(checkpoint, progress=progress, **options).image

    whole, counts, make = image("refuse"), [], phase_space.PhaseSpace.kernels

    def counted(plan, *arguments):
        counts.append(arguments)
        return make(plan, *arguments)

    def batches():
        with np.load(path) as archive:
            return json.loads(str(archive["header"])).get("batches", 0)

    def stop(done, total):
        if path.exists() and batches():
            raise StoppedError

    monkeypatch.setattr(phase_space.PhaseSpace, "kernels", counted)
    with pytest.raises(StoppedError):
        image("refuse", stop)
    made = len(counts)
    assert batches() <= 3
    np.testing.assert_array_equal(image("resume"), whole)
    assert made and len(counts) == made


def test_what_a_report_of_progress_raises_comes_out():
    with pytest.raises(StopIteration, match="enough"):
        render(progress=mock.Mock(side_effect=StopIteration("enough")))


def test_a_second_process_is_refused_until_the_first_has_ended(tmp_path, python):
    path = tmp_path / "raw.checkpoint"
    code = f"""
    from mitsuba_plenoptic import Checkpoint, InputError
    try:
        with Checkpoint({str(path)!r}, "resume") as checkpoint:
            checkpoint.begin((1, 1, 1))
    except InputError as error:
        print(error)
    """
    with Checkpoint(path) as checkpoint:
        checkpoint.begin((1, 1, 1))
        said = python(code).stdout
        assert said == f"{path}: another process is computing this; wait until it has ended\n"
    assert python(code).stdout == "" and list(tmp_path.iterdir()) == []


def test_a_ray_capture_leaves_a_checkpoint_alone(tmp_path, capfd):
    kept = tmp_path / "raw.exr.checkpoint"
    kept.write_bytes(b"days of work")
    words = ["letters", "-o", str(tmp_path / "raw.exr"), "-D", "resolution=64"]
    assert main(["render", *words, "--model", "wave", "--resume"]) == 2
    assert f"{kept}: it is not a checkpoint of this version" in capfd.readouterr().err
    assert main(["render", *words, "--resume"]) == 2
    assert "--resume: a ray capture does not take it" in capfd.readouterr().err
    assert main(["render", *words]) == 0
    assert kept.read_bytes() == b"days of work"
