"""What the command ``calibrate`` says about a user's mistakes."""

from pathlib import Path

import pytest
from foreign_files import LARGE, large
from refusals import refused

from mitsuba_plenoptic.calibration import Board, read_camera, read_centres, read_corners


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("calibrate c.csv -o {out}.json --report {out}.json", "two results would be written to it"),
        ("calibrate w.png -o {out}.csv --board 9x5 --square 3", "--square: detecting corners"),
        ("calibrate --evaluate c.csv --white {raw}", "--white: "),
        ("calibrate a.png --board 4x3 -o {out}.csv", "need a white image"),
        ("calibrate a.png b.csv --board 4x3 -o {out}.csv", "one table of corners"),
        ("calibrate a.png --report a.html -o {out}.csv", "a report is of a calibration"),
        ("calibrate --evaluate a.csv -o {out}.csv", "writes no file"),
    ],
)
def test_mistakes(line, words, mistake, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(tmp_path_factory.mktemp("files"))
    for name in ("a.png", "w.png", "a.csv", "b.csv", "c.csv"):
        Path(name).write_text("k,l")
    mistake(line, words)


BOARD = Board(9, 5, 3.0)

test_the_size_of_a_file_is_judged_before_it_is_read = refused(
    (lambda folder: read_camera(large(folder / "camera.json")), f"camera.json: {LARGE}"),
    (lambda folder: read_corners(large(folder / "corners.csv"), BOARD, (64, 64)), f"corners.csv: {LARGE}"),
    (lambda folder: read_centres(large(folder / "centres.csv")), f"centres.csv: {LARGE}"),
    (lambda folder: read_centres(large(folder / "white.grid.json")), f"white.grid.json: {LARGE}"),
)
