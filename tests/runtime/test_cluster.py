"""Sums on a cluster of processes: the same bits as in one process, whatever happens to the workers."""

import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref

import numpy as np
import pytest
from cameras import HALF, capture, definitions, letters, scattered, small_camera
from refusals import refuses
from stopped_runs import CheckpointStore, start_command

from mitsuba_plenoptic import CaptureOperator, Cluster, InputError, Job
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.runtime import batches as distributed

pytest.importorskip("distributed")

SMALL = small_camera(4, **HALF)
WAVE = ["render", "letters", "--model", "wave", "--method", "points"]


@pytest.fixture(scope="module")
def cluster():
    with Cluster(workers=2) as workers:
        yield workers


@pytest.fixture
def tiny_groups(monkeypatch):
    """Give a worker one batch at a time."""
    monkeypatch.setattr(distributed, "_GROUP_SAMPLES", 1)


def radiators(count, seed=0):
    return scattered(count, distances=(102, 137), image=0.1), np.random.default_rng(seed).uniform(0, 1, count)


def test_two_processes_give_the_bits_of_one(cluster, tiny_groups, count=12):
    positions, weights = radiators(count)
    operator = CaptureOperator(SMALL, positions, wavelength=633)
    calls = []
    alone = operator.forward(weights)
    shared = operator.forward(weights, job=Job(lambda *call: calls.append(call), cluster))
    np.testing.assert_array_equal(shared, alone)
    assert calls[-1] == (count, count)
    np.testing.assert_array_equal(operator.adjoint(alone, job=Job(batch_map=cluster)), operator.adjoint(alone))


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_no_bit(cluster, tiny_groups):
    positions, weights = radiators(60)
    alone = capture(SMALL, positions, weights)
    processes = set(cluster._client.run(os.getpid).values())
    done = []

    def kill_one(snapshot):
        done.append(snapshot.partial.batches)
        if len(done) == 3:
            os.kill(min(processes), signal.SIGKILL)

    shared = capture(SMALL, positions, weights, job=Job(batch_map=cluster, keeper=CheckpointStore(save=kill_one)))
    np.testing.assert_array_equal(shared, alone)
    # It was in the midst of the work, not at its end, that the worker died.
    assert len(done) > 10
    cluster._client.wait_for_workers(2, timeout="60s")
    assert min(processes) not in cluster._client.run(os.getpid).values()


def test_no_more_batches_are_under_way_than_keep_the_workers_busy(cluster, tiny_groups):
    """Memory stays flat: batches are made as their turn comes."""
    positions, weights = radiators(60)
    made, behind = [], []
    call = cluster.__call__

    class Watched:
        workers, threads = 2, 0

        def __call__(self, batches):
            def watch():
                for batch in batches:
                    made.append(len(pickle.dumps(batch)))
                    yield batch

            return call(watch())

    keeper = CheckpointStore(save=lambda state: behind.append(len(made) - state.partial.batches))
    capture(SMALL, positions, weights, job=Job(batch_map=Watched(), keeper=keeper))
    assert len(made) > 10 and max(made) < 2**20
    assert max(behind) <= distributed._AHEAD * 2


def test_a_mistake_in_a_batch_is_told_as_such(cluster, monkeypatch):
    positions, weights = radiators(3)
    monkeypatch.setattr(distributed, "software", lambda: {"mitsuba_plenoptic": "0123"})
    words = r"^a worker: its mitsuba_plenoptic is \w+, here it is 0123"
    refuses(words, capture, SMALL, positions, weights, job=Job(batch_map=cluster))


def test_a_scheduler_at_an_address(cluster, tmp_path):
    address = cluster._client.scheduler.address
    words = [*WAVE, "--spp", "4", *definitions(letters(2))]
    assert main([*words, "-o", str(tmp_path / "alone.exr")]) == 0
    assert main([*words, "-o", str(tmp_path / "shared.exr"), "--scheduler", address]) == 0
    assert (tmp_path / "alone.exr").read_bytes() == (tmp_path / "shared.exr").read_bytes()


@pytest.mark.slow
def test_a_scheduler_that_dies_is_told_in_one_line_and_the_checkpoint_stays(tmp_path):
    logs = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    file = tmp_path / "scheduler.json"
    command = [sys.executable, "-m", "distributed.cli.dask_{}", "--scheduler-file", str(file)]
    words = ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
    scheduler = subprocess.Popen([*(word.format("scheduler") for word in command), *words], **logs)
    words = ["--nthreads", "2", "--no-dashboard"]
    worker = subprocess.Popen([*(word.format("worker") for word in command), *words], **logs)
    try:
        deadline = time.monotonic() + 60
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        output = tmp_path / "raw.exr"
        words = [*WAVE, "--spp", "16", "-o", str(output), *definitions(letters(8))]
        run = start_command(*words, "--scheduler", address)
        while not (checkpoint := tmp_path / "raw.exr.checkpoint").exists() and run.poll() is None:
            time.sleep(0.005)
        scheduler.kill()
        _, errors = run.communicate(timeout=120)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()
    assert run.returncode == 2, errors
    assert errors.splitlines()[-1].startswith(f"mitsuba-plenoptic: error: scheduler {address}: the connection was lost")
    assert "Traceback" not in errors and checkpoint.exists() and not output.exists()
    assert main([*words, "--resume"]) == 0
    resumed = output.read_bytes()
    assert main(words) == 0
    assert output.read_bytes() == resumed


@pytest.mark.slow
def test_dask_is_left_as_it_was(monkeypatch, address="tcp://127.0.0.1:1"):
    """A client that never connected is closed at once: within the start of the next it would wait for itself."""
    dask, package, clients = pytest.importorskip("dask"), pytest.importorskip("distributed"), []

    class Client(package.Client):
        def __init__(self, *arguments, **options):
            clients.append(weakref.ref(self))
            super().__init__(*arguments, **options)

    monkeypatch.setattr(package, "Client", Client)
    monkeypatch.setattr(distributed, "_PATIENCE", "1s")
    before = dask.config.get("scheduler", None)
    refuses(f"scheduler {address}: no workers can be had", Cluster(scheduler=address).__enter__)
    assert dask.config.get("scheduler", None) == before
    assert not any(client() for client in clients)


@pytest.mark.parametrize("greeting", [pytest.param(b"", marks=pytest.mark.slow), b"HTTP/1.1 400 Bad Request\r\n"])
def test_what_listens_and_is_no_scheduler_is_refused_within_seconds(greeting):
    """A silent program as well as one whose words Dask takes for the length of a message."""

    def answer():
        opened = server.accept()[0]
        opened.sendall(greeting)
        while opened.recv(2**16):
            pass

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=answer, daemon=True).start()
        start = time.monotonic()
        with pytest.raises(InputError, match="what listens there is no scheduler"):
            Cluster(scheduler=f"127.0.0.1:{server.getsockname()[1]}").__enter__()
        assert time.monotonic() - start < 15


def test_outside_its_context_a_cluster_has_no_workers():
    cluster = Cluster(scheduler="tcp://127.0.0.1:1")
    for use in (lambda: cluster.workers, lambda: list(cluster([]))):
        refuses("^scheduler tcp://127.0.0.1:1: .* within: with mp.Cluster", use)


def test_without_dask_the_error_tells_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    refuses("pip install distributed", Cluster(workers=2).__enter__)
