"""Light fields of MATLAB from strangers: they reach nothing, and take no more than they are."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import scipy.io
from foreign_files import write_matlab_7

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.exchange import open_light_field


def test_hdf5_links_lead_nowhere(tmp_path):
    numbers = np.ones((2, 4, 4, 3, 3), np.uint8)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["LF"] = numbers
    (tmp_path / "secret").write_bytes(b"s" * numbers.size)

    def external(file):
        file["LF"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "LF")

    def storage(file):
        file.create_dataset("LF", numbers.shape, np.uint8, external=[(str(tmp_path / "secret"), 0, numbers.size)])

    def virtual(file):
        layout = h5py.VirtualLayout(numbers.shape, np.uint8)
        layout[...] = h5py.VirtualSource(str(tmp_path / "other.h5"), "LF", numbers.shape)
        file.create_virtual_dataset("LF", layout)

    for make in (external, storage, virtual):
        path = write_matlab_7(tmp_path / "lf.mat", make)
        with pytest.raises(InputError, match="links to other files are not followed"):
            open_light_field(path)
    whole = write_matlab_7(tmp_path / "lf.mat", lambda file: file.create_dataset("LF", data=numbers))
    assert open_light_field(whole).shape == (3, 3, 4, 4)


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


@pytest.mark.parametrize(
    ("start", "words"),
    [
        (b"", "it is not a MATLAB file of version 5 or 7.3: it does not begin as one does"),
        (b"MATLAB 5.0".ljust(126) + b"IM", "it is damaged: at byte 128 no variable begins"),
    ],
)
def test_zeros_are_not_read_to_their_end(start, words, tmp_path):
    path = tmp_path / "lf.mat"
    path.write_bytes(start)
    with path.open("r+b") as file:
        file.truncate(2**32)
    with pytest.raises(InputError, match=words):
        open_light_field(path)


def test_matlab_structures_that_unpack_into_more_than_memory(tmp_path, monkeypatch):
    path, model = tmp_path / "lf.mat", {"HSpacing": np.zeros(2**24)}
    numbers = np.ones((4, 4, 3, 3, 3), np.uint8)
    scipy.io.savemat(path, {"LF": numbers, "LensletGridModel": model}, do_compression=True)
    assert path.stat().st_size < 2**20
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", "0.1")
    with pytest.raises(InputError, match=r"it unpacks into more than \d+ bytes"):
        open_light_field(path)
