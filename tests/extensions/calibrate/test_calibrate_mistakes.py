"""What the command ``calibrate`` says about a user's mistakes."""

import pytest


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("calibrate c.csv -o {out}.json --report {out}.json", "two results would be written to it"),
        ("calibrate w.png -o {out}.csv --square 3", "--square: finding centres in white images does not take it"),
        ("calibrate w.png -o {out}.csv --camera paper", "--camera: finding centres in white images does not take it"),
        ("calibrate w.png -o {out}.csv --board 9x5 --square 3", "--square: detecting corners does not take it"),
        ("calibrate c.csv -o {out}.json --linear", "--linear: a calibration from corners does not take it"),
        ("calibrate --evaluate c.csv --white {raw}", "--white: an evaluation does not take it"),
    ],
)
def test_mistakes(line, words, mistake):
    mistake(line, words)


def test_what_is_read_is_not_written_over(tmp_path, complaint):
    (tmp_path / "copy.exr").write_bytes(b"content")
    said = complaint("calibrate", tmp_path / "copy.exr", "-o", tmp_path / "copy.exr")
    assert "it is read, and would be lost; write to another file" in said
    assert (tmp_path / "copy.exr").read_bytes() == b"content"
