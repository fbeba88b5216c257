"""Files of MATLAB that hold no light field, or a larger one than memory."""

import numpy as np
import pytest
import scipy.io
from foreign_files import write_matlab_7

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.exchange import open_light_field


def test_hdf5_that_claims_more_than_memory(tmp_path):
    path = write_matlab_7(
        tmp_path / "lf.mat",
        lambda file: file.create_dataset("LF", (2, 10**6, 10**6, 9, 9), np.uint8, chunks=(1, 16, 16, 3, 3)),
    )
    assert path.stat().st_size < 10_000
    with pytest.raises(InputError, match=r"shape .*: it would need .* GiB"):
        open_light_field(path)


def test_objects_of_matlab_are_no_light_field(tmp_path):
    path = tmp_path / "lf.mat"
    for wrong in (np.array([[1, "a"]], dtype=object), {"a": 1.0}, "text", np.ones((3, 3, 4, 4)) * 1j):
        scipy.io.savemat(path, {"LF": wrong})
        with pytest.raises(InputError, match="not an array of numbers"):
            open_light_field(path)


@pytest.mark.parametrize("content", [bytes(512), b"MATLAB 5.0".ljust(126) + b"IM" + b"x" * 100, b""])
def test_what_is_no_file_of_matlab_is_refused(content, tmp_path):
    path = tmp_path / "lf.mat"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"lf\.mat: it cannot be read as a light field: [^\n]+$"):
        open_light_field(path)
