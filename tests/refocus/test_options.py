"""Options of methods: each has methods that take it, and a type; `tests/test_extensions.py` adds one by a package."""

import inspect

import pytest

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.refocus_options import all_options, method_names, options_of_methods


@pytest.mark.needs_extension("deconvolution")
def test_every_record_has_a_method_that_takes_it_and_a_type():
    assert tuple(mp.refocus.METHODS) == method_names()
    for method, options in options_of_methods().items():
        for name, option in options.items():
            assert mp.refocus.METHODS[method].takes(name)
            assert option.types and option.text.endswith(".")
    assert all_options()["relay"].text.startswith("For coherent and partial: whether")


def test_a_signature_states_no_default_that_the_method_has_not():
    """Flags that are on by default, such as `relay`, are None in the signature: the method's default."""
    parameters = inspect.signature(mp.reconstruct).parameters
    assert {parameters[name].default for name in all_options()} == {None}
