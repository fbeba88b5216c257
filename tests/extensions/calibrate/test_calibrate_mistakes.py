"""What the command ``calibrate`` says about a user's mistakes."""

import pytest
from foreign_files import large

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.calibration import Board, read_camera, read_centres, read_corners


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("calibrate c.csv -o {out}.json --report {out}.json", "two results would be written to it"),
        ("calibrate w.png -o {out}.csv --square 3", "--square: finding centres in white images does not take it"),
        ("calibrate w.png -o {out}.csv --camera paper", "--camera: finding centres in white images does not take it"),
        ("calibrate w.png -o {out}.csv --board 9x5 --square 3", "--square: detecting corners does not take it"),
        ("calibrate c.csv -o {out}.json --linear", "--linear: a calibration from corners does not take it"),
        ("calibrate --evaluate c.csv --white {raw}", "--white: an evaluation does not take it"),
        ("calibrate a.png --board 4x3 -o {out}.csv", "need a white image"),
        ("calibrate a.png b.csv --board 4x3 -o {out}.csv", "one table of corners"),
        ("calibrate a.png --report a.html -o {out}.csv", "a report is of a calibration"),
        ("calibrate --evaluate a.csv -o {out}.csv", "writes no file"),
    ],
)
def test_mistakes(line, words, mistake):
    mistake(line, words)


def test_what_is_read_is_not_written_over(tmp_path, complaint):
    (tmp_path / "copy.exr").write_bytes(b"content")
    said = complaint("calibrate", tmp_path / "copy.exr", "-o", tmp_path / "copy.exr")
    assert "it is read, and would be lost; write to another file" in said
    assert (tmp_path / "copy.exr").read_bytes() == b"content"


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("camera.json", read_camera),
        ("corners.csv", lambda path: read_corners(path, Board(9, 5, 3.0), (64, 64))),
        ("centres.csv", read_centres),
        ("white.grid.json", read_centres),
    ],
)
def test_the_size_of_a_file_is_judged_before_it_is_read(tmp_path, name, read):
    with pytest.raises(InputError, match=rf"{name}: 3221225472 bytes: it may have at most \d+"):
        read(large(tmp_path / name))
