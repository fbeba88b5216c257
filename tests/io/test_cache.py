"""The cache: entries by their keys, from one run to the next, for two processes at once, and on a full disk."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.io import cache
from mitsuba_plenoptic.io.cache import Cache, StageOptions


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_an_entry_is_made_once_for_each_key(tmp_path):
    made, told = [], []
    for inputs, runs in (({"a": 1}, 1), ({"a": 1}, 1), ({"a": 2}, 2), ({"a": 1}, 3)):
        store = Cache(tmp_path, StageOptions(finished=lambda *told_of: told.append(told_of)))
        facts = store.facts("facts", inputs, lambda _: made.append(1) or {"answer": 42})
        assert facts == {"answer": 42} and len(made) == runs
    assert [was_there for _, _, was_there in told] == [False, True, False, False]
    # What an entry took is known to the run that finds it.
    assert told[0][1] == told[1][1]
    assert names(tmp_path) == [".facts.json.key", "facts.json"]


def test_other_software_makes_entries_again(tmp_path, monkeypatch):
    Cache(tmp_path).facts("facts", {}, lambda _: {"by": "old"})
    monkeypatch.setattr(cache, "software", lambda: {"mitsuba_plenoptic": "new"})
    assert Cache(tmp_path).facts("facts", {}, lambda _: {"by": "new"}) == {"by": "new"}


@pytest.mark.parametrize("name", ["image.exr", ".image.exr.key"])
@pytest.mark.parametrize("damage", [lambda content: content[: len(content) // 2], lambda _: b""])
def test_what_is_damaged_is_made_again(tmp_path, name, damage):
    make = Mock(return_value=(np.arange(64, dtype=np.float32).reshape(8, 8), {"kind": "image"}))
    first, key = Cache(tmp_path).image("image", {}, make)
    path = tmp_path / name
    path.write_bytes(damage(path.read_bytes()))
    for _ in range(2):
        again, same = Cache(tmp_path).image("image", {}, make)
        np.testing.assert_array_equal(again, first)
        assert key == same and make.call_count == 2


def test_an_entry_that_another_process_makes_is_refused(tmp_path):
    def make(_):
        with pytest.raises(InputError, match=r"facts\.json: another process is making this stage; wait until it has"):
            Cache(tmp_path).facts("facts", {}, lambda _: {})
        return {"answer": 42}

    assert Cache(tmp_path).facts("facts", {}, make) == {"answer": 42}
    assert names(tmp_path) == [".facts.json.key", "facts.json"]


def test_a_full_disk_loses_nothing_finished(tmp_path, monkeypatch):
    Cache(tmp_path).facts("first", {}, lambda _: {"answer": 42})
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr(cache, "write_json", Mock(side_effect=OSError("No space left on device")))
        Cache(tmp_path).facts("second", {}, lambda _: {})
    assert Cache(tmp_path).facts("first", {}, lambda _: pytest.fail("made again")) == {"answer": 42}
    assert Cache(tmp_path).facts("second", {}, lambda _: {"answer": 43}) == {"answer": 43}


def test_a_file_of_another_key_is_never_taken(tmp_path, monkeypatch):
    """Where a run ends between the file and its key."""
    Cache(tmp_path).facts("facts", {"a": 1}, lambda _: {"a": 1})
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(cache, "write_text", Mock(side_effect=KeyboardInterrupt))
        Cache(tmp_path).facts("facts", {"a": 2}, lambda _: {"a": 2})
    assert Cache(tmp_path).facts("facts", {"a": 1}, lambda _: {"a": 1}) == {"a": 1}
