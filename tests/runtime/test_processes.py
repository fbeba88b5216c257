"""Threads, processes, variants and imports: what may run at once, and that the same seed gives the same bits."""

import gc
import signal
import sys
import textwrap
import threading
import time
from functools import partial
from types import SimpleNamespace
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.runtime import fft, garbage


@pytest.mark.slow
def test_the_same_bits_by_two_threads_at_once(python, tmp_path):
    """And of reconstructions on any number: images by single lenses follow the BLAS's threads in their last bits."""
    code = """
    import sys, drjit as dr, mitsuba as mi, numpy as np
    from concurrent.futures import ThreadPoolExecutor
    import mitsuba_plenoptic as mp
    mi.set_variant("llvm_ad_mono")
    count, found = int(sys.argv[2]), {}
    dr.set_thread_count(count)

    def work(seed):
        scene = mp.load_scene("still_life", parameters={"detector_width": "0.128", "resolution": "64"})
        for model in ("ray", "wave"):
            made = mp.render_capture(scene, model=model, spp=5, seed=seed)
            found[f"{model} {seed}"] = made.image
        for method, options in (("ray", {}), ("coherent", {}), ("partial", {"interleave": "auto"})):
            found[f"{method} refocused {seed}"] = mp.reconstruct(made, 240, method=method, **options).image

    with ThreadPoolExecutor(count) as pool:
        list(pool.map(work, (0, 1)))
    np.savez(sys.argv[1], **found)
    """
    for threads in (1, 2):
        result = python(code, tmp_path / f"{threads}.npz", threads, OPENBLAS_NUM_THREADS=str(threads))
        assert result.returncode == 0, result.stderr
    one, two = (np.load(tmp_path / f"{threads}.npz") for threads in (1, 2))
    assert len(one.files) == 10 and not np.array_equal(one["ray 0"], one["ray 1"])
    for name in one.files:
        rounding = 1e-4 if name.startswith("partial") else 0.0
        np.testing.assert_allclose(one[name], two[name], rtol=rounding, atol=rounding * 1e-2 * one[name].max())


def test_ctrl_c_within_a_collection_of_garbage_comes_after_it(monkeypatch):
    flags = mock.Mock(side_effect=[KeyboardInterrupt, *[False] * 100])
    # pytest's hook stands before that of the import.
    monkeypatch.setattr(sys, "unraisablehook", print)
    garbage.watch_collections()
    gc.callbacks.pop()
    # Programs in the background of a shell ignore interrupts. The last change is dr, as Python may collect by itself.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(garbage, "dr", mock.Mock(flag=flags))
    gc.collect()
    with pytest.raises(KeyboardInterrupt):
        for _ in range(100):
            time.sleep(0.05)
    signal.signal(signal.SIGINT, before)


def test_scenes_of_another_variant_and_variants_that_cannot_work_are_refused():
    scene = mp.load_scene("letters", variant="llvm_ad_mono")
    for variant in ("llvm_ad_rgb", "scalar_rgb"):
        mi.set_variant(variant)
        refuses(f"it must be a mitsuba.Scene of the active variant {variant},", mp.render_capture, scene)
    refuses("variant scalar_rgb: this plugin needs an llvm_ad_", mp.load_scene, "letters")


def test_the_package_is_imported_after_a_variant_is_chosen(python):
    result = python("""
    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    import mitsuba_plenoptic
    mi.set_variant("llvm_ad_mono")
    print(mi.load_dict(mitsuba_plenoptic.PlenopticCamera().to_sensor()).camera.f_number, mi.variant())
    """)
    assert result.stdout.endswith("8.0 llvm_ad_mono\n"), result.stderr


@pytest.mark.slow
def test_a_spawned_process_works_and_a_forked_one_says_why_it_cannot(python, tmp_path):
    """Threads do not survive a fork: without the check the child waits for ever."""
    script = """
    import multiprocessing
    import mitsuba_plenoptic as mp

    def render(queue):
        try:
            scene = mp.load_scene("letters", parameters={"detector_width": "0.128", "resolution": "64"})
            queue.put(float(mp.render_capture(scene, spp=1).image.sum()))
        except mp.InputError as error:
            queue.put(str(error))

    if __name__ == "__main__":
        # before Dr.Jit is at work a fork does no harm
        for way, first in (("fork", False), ("spawn", True), ("fork", True)):
            context = multiprocessing.get_context(way)
            queue = context.SimpleQueue()
            if first:
                render(queue)
                print(queue.get())
            process = context.Process(target=render, args=(queue,))
            process.start()
            print(queue.get())
            process.join()
    """
    # A spawned process imports the program, which must be a file.
    (tmp_path / "script.py").write_text(textwrap.dedent(script))
    result = python("import runpy, sys; runpy.run_path(sys.argv[1], run_name='__main__')", tmp_path / "script.py")
    early, parent, spawned, again, forked = result.stdout.splitlines()
    assert early == parent == spawned == again
    assert "get_context('spawn')" in forked


def test_a_thread_that_missed_its_request_to_stop_is_woken(monkeypatch, request):
    """The request returns only once there is a task, as where a thread sleeps; nothing is compiled for it."""
    woken, recorded = threading.Event(), dr.flag(dr.JitFlag.KernelHistory)
    request.addfinalizer(partial(dr.set_thread_count, dr.thread_count()))
    request.addfinalizer(partial(dr.set_flag, dr.JitFlag.KernelHistory, recorded))
    nanothread = fft._nanothread()

    def resize(pool, count, parked):
        assert woken.wait(10)
        nanothread.pool_set_size(pool, count, parked)

    def submit(*arguments):
        woken.set()
        return nanothread.task_submit_dep(*arguments)

    wait = nanothread.task_wait_and_release
    stand_in = SimpleNamespace(pool_set_size=resize, task_submit_dep=submit, task_wait_and_release=wait)
    monkeypatch.setattr(fft, "_nanothread", lambda: stand_in)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    dr.kernel_history_clear()
    dr.set_thread_count(3)
    fft.stop_threads()
    assert dr.thread_count() == 1
    assert dr.kernel_history() == []


AT_THE_END_OF_A_PAGE = """
import ctypes, mmap
import mitsuba as mi
import numpy as np
from mitsuba_plenoptic.optics.waves import advance

mi.set_variant("llvm_ad_mono")
page, shape = mmap.PAGESIZE, (3, 5)
memory = mmap.mmap(-1, 2 * page)
start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
libc = ctypes.CDLL(None)
libc.mprotect.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
assert libc.mprotect(start + page, page, 0) == 0
field = np.frombuffer(memory, np.complex64, 15, page - 15 * 8).reshape(shape)
field[:] = np.arange(15).reshape(shape)
options = {"shift": (0.0, 0.0), "part": None, "paraxial": False, "beyond_paraxial": False, "response": None}
np.testing.assert_array_equal(advance(field, 0.01, 0.0, 633.0, **options), field)
print("fine")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="pages are protected as on Linux")
def test_fields_that_end_with_a_page(python):
    """The next page is protected: reading it would end the process."""
    made = python(AT_THE_END_OF_A_PAGE)
    assert (made.returncode, made.stdout.strip()) == (0, "fine"), made.stderr


@pytest.mark.slow
def test_python_without_docstrings_and_assertions(python):
    code = """
    import sys, mitsuba as mi
    import mitsuba_plenoptic as mp
    from mitsuba_plenoptic.cli.program import COMMANDS, main
    mi.set_variant("llvm_ad_mono")
    small = {"detector_width": "0.256", "resolution": "64"}
    for model in ("ray", "wave"):
        capture = mp.render_capture(mp.load_scene("letters", parameters=small), model=model, spp=2)
        for method in ("ray", "coherent"):
            if not mp.reconstruct(capture, 240, method=method, wavelength=633).image.max() > 0:
                sys.exit(method)
    for name in COMMANDS:
        if main([*name.split(), "--help"]):
            sys.exit(name)
    print("right")
    """
    assert python(code, PYTHONOPTIMIZE="2").stdout.endswith("right\n")


@pytest.mark.parametrize("swept", [pytest.param("frozen", marks=pytest.mark.slow), "symbolic"])
def test_collected_garbage_destroys_no_scene_that_drjit_counts(python, swept):
    told = python(
        """
        import gc, sys
        import drjit as dr, mitsuba as mi, numpy as np
        import mitsuba_plenoptic as mp
        mi.set_variant("llvm_ad_mono")
        sweeping = False

        class Swept(mi.BSDF):
            def __init__(self, props):
                super().__init__(props)
                self.inner = mi.load_dict({"type": "diffuse"})
                self.m_components, self.m_flags = [self.inner.flags()], self.inner.flags()

            def sample(self, *arguments):
                if sweeping:
                    gc.collect()
                return self.inner.sample(*arguments)

            eval = lambda self, *arguments: self.inner.eval(*arguments)
            pdf = lambda self, *arguments: self.inner.pdf(*arguments)
            eval_pdf = lambda self, *arguments: self.inner.eval_pdf(*arguments)

        mi.register_bsdf("swept", Swept)

        def scene():
            sensor = mp.PlenopticCamera(resolution=(32, 32), detector_width=0.128, detector_blur=0.004).to_sensor()
            ball = {"type": "sphere", "center": [0, 0, 240], "radius": 9, "bsdf": {"type": "swept"}}
            parts = {"i": {"type": "path"}, "e": {"type": "constant"}, "s": sensor}
            return mi.load_dict({"type": "scene", **parts, **({"ball": ball} if sys.argv[1] == "symbolic" else {})})

        def garbage():
            held = {"scene": scene()}
            held["parameters"], held["itself"] = mi.traverse(held["scene"]), held
            mi.render(held["scene"], spp=1)

        def render(scene, seed):
            if sys.argv[1] == "frozen":
                gc.collect()
            return mi.render(scene, spp=2, seed=seed)

        gc.disable()
        for _ in range(2):
            garbage()
            kept = scene()
            frozen = dr.freeze(render) if sys.argv[1] == "frozen" else render
            for seed in (1, 2):
                expected = np.array(mi.render(kept, spp=2, seed=seed))
                garbage()
                sweeping = True
                assert np.array_equal(frozen(kept, mi.UInt32(seed)), expected)
                sweeping = False
        assert gc.get_freeze_count() == 0 and gc.collect() > 10
        print("right")
        """,
        swept,
    )
    assert told.stdout.endswith("right\n"), told.stderr
