"""An option of a method is written once, and its signature, checks and command follow."""

from typing import get_type_hints

import pytest

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.refocus_options import OPTIONS, MethodOptions


def test_an_option_that_is_added_in_one_place_is_found_in_all(python):
    field = """
    sharpness: Annotated[float | None, Option(("mean",), "how sharp the mean is.", default=1.5,
        check=lambda name, value, _: require_number(name, value, maximum=9))]
"""
    code = f"""
    import contextlib, importlib.util, inspect, io, sys
    spec = importlib.util.find_spec("mitsuba_plenoptic.refocus_options")
    text = open(spec.origin).read()
    end = text.index("_FIELDS = ")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    exec(compile(text[:end].rstrip() + {field!r} + text[end:], spec.origin, "exec"), vars(module))

    import numpy as np
    import mitsuba_plenoptic as mp
    from mitsuba_plenoptic.cli import main
    from mitsuba_plenoptic.refocus.methods import method

    @method("mean", waves=False)
    def mean(task, *, sharpness):
        return [np.full((*task.camera.bin_count[::-1], 1), sharpness) for _ in task.distances]

    assert inspect.signature(mp.reconstruct).parameters["sharpness"].annotation == float | None
    assert "sharpness : float, optional" in mp.reconstruct.__doc__
    camera = mp.PlenopticCamera(detector_width=0.128, resolution=(64, 64))
    taken = dict(capture=np.ones((64, 64)), distance=240.0, camera=camera, method="mean")
    assert (mp.reconstruct(**taken).image == 1.5).all()
    found = mp.reconstruct(**taken, sharpness=2)
    assert (found.image == 2).all() and found.options == {{"sharpness": 2.0, "oversample": 1}}
    for wrong in (10, "much"):
        with contextlib.suppress(mp.InputError):
            mp.reconstruct(**taken, sharpness=wrong)
            raise SystemExit(f"{{wrong}} is taken")

    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        main(["reconstruct", "--help"])
    assert "--sharpness" in shown.getvalue() and "For mean: how sharp" in shown.getvalue()
    """
    done = python(code)
    assert done.returncode == 0, done.stderr


@pytest.mark.needs_extension("deconvolution")
def test_every_record_has_a_method_that_takes_it_and_a_type():
    for name, option in OPTIONS.items():
        assert option.methods and all(mp.refocus.METHODS[method].takes(name) for method in option.methods)
        assert option.types and option.text.endswith(".")
    assert get_type_hints(MethodOptions).keys() == OPTIONS.keys()
