"""Calibration from corners: known cameras come back, deviations are true, and mistakes get one line."""

import json
from pathlib import Path

import calibration_cases as cases
import numpy as np
import pytest
from foreign_files import LARGE, large
from refusals import refused, refuses

from mitsuba_plenoptic import InputError, PlenopticCamera, calibrate
from mitsuba_plenoptic import calibration as cal
from mitsuba_plenoptic.array import Conic
from mitsuba_plenoptic.calibration import Board, read_camera, read_centres, read_corners
from mitsuba_plenoptic.extensions.calibrate.adjustment import Problem, adjust
from mitsuba_plenoptic.extensions.calibrate.board_model import NAMES, Observations, numbers_of, predict_centres

NOISE = 0.1
START = PlenopticCamera.preset("raytrix").replace(resolution=(2000, 1500), crop_size=(2000, 1500), detector_width=11.0)


@pytest.fixture(scope="module")
def table():
    return cases.corners(NOISE)[0]


@pytest.fixture(scope="module")
def centres():
    k, l = (index.ravel() for index in np.mgrid[0:81, 0:73])  # noqa: E741
    pixel, _ = predict_centres(numbers_of(cases.CAMERA), cases.INDEX.unit(k, l), pixel_size=0.0055, row_ratio=0.75**0.5)
    kept = ((pixel > 12) & (pixel < np.array(cases.CAMERA.crop_size) - 12)).all(1)
    # A third of them, as a fit's time goes with their number.
    kept &= np.random.default_rng(6).random(len(kept)) < 1 / 3
    pixel = pixel[kept] + np.random.default_rng(5).normal(0, 0.05, (kept.sum(), 2))
    return cal.Table("centres.csv", {"k": k[kept], "l": l[kept], "u": pixel[:, 0], "v": pixel[:, 1]})


@pytest.fixture(scope="module")
def found(table, centres):
    return calibrate(table, cases.BOARD, START, centres)


def test_boards_are_evaluated_whichever_way_they_are_turned():
    poses = (cases.POSES * [1, 1, 0, -1, -1, 1])[:3] + [[0, 0, turn, 0, 0, 0] for turn in (-0.5, -0.05, 0.0)]
    assert cal.evaluate(cases.corners(poses=poses)[0], cases.BOARD, cases.CAMERA).error < 1e-6


def test_a_known_camera_comes_back(found, table, tmp_path):
    # Noise is 0.1 pixels an axis; every number lies within four deviations, the principal point rounded.
    assert found.evaluation.error == pytest.approx(NOISE * 2**0.5, rel=0.05)
    true = dict(zip(NAMES, numbers_of(cases.CAMERA), strict=True))
    for name in ("focal_length", "mla_distance", "detector_distance", "pitch_along", "pitch_across", "k1"):
        assert abs(found.numbers[name] - true[name]) < 4 * found.deviations[name] + 1e-9, name
    assert found.numbers["focal_length"] == pytest.approx(true["focal_length"], rel=0.02)
    np.testing.assert_allclose(found.evaluation.poses[:, 5], cases.POSES[:, 5], rtol=0.01)
    assert found.camera.crop_size == START.crop_size and len(found.evaluation.outliers) < 3
    # Its file explains as much.
    cal.write_calibration(tmp_path / "camera.json", found, cases.BOARD)
    assert read_camera(tmp_path / "camera.json") == (found.camera, found.index)
    again = cal.evaluate(table, cases.BOARD, found.camera, found.index)
    assert again.error == pytest.approx(found.evaluation.error, rel=1e-3)


@pytest.mark.slow
def test_deviations_are_true():
    # The mean squared error over the variance, of each combination of the numbers that the data tell well; with little
    # noise, so that the model is linear over the errors.
    noise = 0.02
    every = cases.corners()[1]
    rows = slice(None, None, max(1, len(every) // 800))
    seen = Observations(every.lens[rows], every.pixel[rows], every.board[rows], every.pose[rows])
    true = numbers_of(cases.CAMERA)
    lens = every.lens[:: max(1, len(every) // 400)]
    middle, _ = predict_centres(true, lens, pixel_size=0.0055, row_ratio=0.75**0.5)
    ratios = []
    for seed in range(40):
        generator = np.random.default_rng(seed)
        pixel, at = (exact + generator.normal(0, noise, exact.shape) for exact in (seen.pixel, middle))
        corners = Observations(seen.lens, pixel, seen.board, seen.pose)
        problem = Problem(corners, 0.0055, 0.75**0.5, Observations(lens, at, at, at))
        found = adjust(problem, true, cases.POSES)
        # Rows of the camera alone: what the poses leave undecided is not counted.
        _, rows = problem.blocks(found.numbers, found.poses, np.ones(len(seen)), np.arange(len(NAMES)))
        triangle = np.linalg.qr(np.concatenate(rows)[:, :-1], mode="r") / noise
        _, singular, directions = np.linalg.svd(triangle / np.abs(triangle).max(0))
        error = (found.numbers - true) * np.abs(triangle).max(0)
        ratios.append((singular * (directions @ error))[:12])
    mean = (np.array(ratios) ** 2).mean(0)
    assert (mean > 0.45).all() and (mean < 1.8).all()
    assert mean.mean() == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_gross_errors_are_named_and_change_nothing(table, centres, found):
    generator = np.random.default_rng(3)
    columns, rows = {name: values.copy() for name, values in table.columns.items()}, len(table["k"])
    bad = generator.choice(rows, int(rows * 0.05), replace=False)
    far, other = np.array_split(bad, 2)
    for name in "uv":
        columns[name][far] += generator.choice([-1, 1], len(far)) * generator.uniform(20, 500, len(far))
    columns["cluster"][other] = (columns["cluster"][other] + generator.integers(1, 24, len(other))) % 24
    spoiled = calibrate(cal.Table("corners.csv", columns), cases.BOARD, START, centres)
    assert set(bad) <= set(spoiled.evaluation.outliers) and len(spoiled.evaluation.outliers) < len(bad) + 3
    assert spoiled.evaluation.error_without_outliers == pytest.approx(NOISE * 2**0.5, rel=0.05)
    for name, value in spoiled.numbers.items():
        # A twentieth of the rows less moves numbers by a fifth of their deviations.
        assert abs(value - found.numbers[name]) < 1.5 * found.deviations[name] + 1e-12, name
    again = cal.evaluate(cal.Table("corners.csv", columns), cases.BOARD, spoiled.camera)
    assert set(bad) <= set(again.outliers)
    assert again.error_without_outliers == pytest.approx(NOISE * 2**0.5, rel=0.05)


@pytest.mark.slow
def test_wrong_centres_are_left_out(table, centres, found):
    bad = np.arange(7, len(centres["k"]), 50)
    columns = {**centres.columns, "u": centres["u"].copy(), "doubtful": np.zeros(len(centres["k"]), dtype=int)}
    columns["u"][bad[::2]] += 9
    columns["doubtful"][bad[1::2]] = 1
    spoiled = calibrate(table, cases.BOARD, START, cal.Table("c.csv", columns))
    np.testing.assert_array_equal(spoiled.centre_outliers, bad)
    for name in NAMES:
        assert abs(spoiled.numbers[name] - found.numbers[name]) < found.deviations[name] + 1e-12


def bent_frames(table, size):
    """Displace each frame by a smooth field of its own, in pixels: rows of a frame err together."""
    columns = {name: values.copy() for name, values in table.columns.items()}
    generator = np.random.default_rng(0)
    for frame in np.unique(table["frame"]):
        mine = table["frame"] == frame
        x, y = (columns["u"][mine] / 1000 - 1, columns["v"][mine] / 750 - 1)
        for name in "uv":
            columns[name][mine] += size * np.array([x, y, x * y, x * x, y * y]).T @ generator.normal(size=5)
    return cal.Table("corners.csv", columns)


@pytest.mark.slow
def test_what_the_model_misses_is_in_the_deviations(table, centres, found):
    assert not found.by_frames
    # As large as the noise.
    bent = calibrate(bent_frames(table, 0.1), cases.BOARD, START, centres)
    assert bent.by_frames and bent.disagreement > 2
    true = dict(zip(NAMES, numbers_of(cases.CAMERA), strict=True))
    told = [name for name in NAMES if not name.startswith("offset")]
    apart = [(bent.numbers[name] - true[name]) / bent.deviations[name] for name in told]
    assert np.sqrt(np.mean(np.square(apart))) < 1.5


STRAIGHT = np.indices((60, 50)).reshape(2, -1)
CENTRES = cal.Table("centres.csv", dict(zip("kluv", [*STRAIGHT, *(30.0 + 23.3 * STRAIGHT)], strict=True)))
"""Those of a square lattice."""

ONE_DISTANCE = np.tile([0.0, 0.0, 3.1, 14, 9, 300], (3, 1)) + [[0, 0, 0, shift, shift, 0] for shift in range(3)]


def frame_12(table, **changes):
    chosen = table["frame"] == 12
    return {**table.columns, **{name: np.where(chosen, values, table[name]) for name, values in changes.items()}}


def mirrored(table):
    cluster, columns = table["cluster"], cases.BOARD.columns
    return {**table.columns, "cluster": cluster - 2 * (cluster % columns) + columns - 1}


def counted_along_columns(table):
    """The same lenses, counted along what was their columns: shifted rows half a pitch apart."""
    x, y = (cases.INDEX.unit(table["k"], table["l"]) * [2, 1]).round().astype(int).T
    return {**table.columns, "k": y // 2, "l": x}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (mirrored, "mirrored"),
        (
            lambda table: frame_12(table, cluster=np.random.default_rng(0).integers(0, 24, len(table["k"]))),
            "frame 12: most of its corners",
        ),
        (lambda table: frame_12(table, u=table["u"] + 60), "frame 12: 300 of its 300"),
        (lambda table: table.keep(table["frame"] < 12).columns, "2 poses .* at least 3"),
        (lambda table: table.keep(table["cluster"] < 5).columns, "corners of the board are seen"),
        (lambda table: {**table.columns, "u": table["u"] * 5.5}, "detector has 2000 x 1500 pixels"),
        (lambda table: {**table.columns, "u": table["u"] * 0.0055, "v": table["v"] * 0.0055}, "must be in pixels"),
        (lambda table: {**table.columns, "k": table["l"], "l": table["k"] * 0}, "one line"),
        (lambda table: {**table.columns, "k": table["k"][::-1]}, "regular grid"),
        (counted_along_columns, "turn pictures of a hexagonal lattice by 90 degrees"),
        (lambda table: cases.corners(0.0, 0, ONE_DISTANCE)[0].columns, "same distance"),
    ],
)
def test_mistakes_get_one_line(table, change, words):
    refuses(words, calibrate, cal.Table("corners.csv", change(table)), cases.BOARD, START)


@pytest.mark.parametrize(("board", "start", "given", "words"), [
    (Board(4, 6, 6.0), START, None, "board of 4x6 inner corners: they do on one with 6 along each row"),
    (Board(6, 4, 60.0), START, None, "squares of 60 mm"),
    (cases.BOARD, START.replace(mla_lattice="square", mla_focal_length=0.56), None, "odd rows .* mla_lattice"),
    (cases.BOARD, START.replace(mla_shape=Conic(0.25), mla_focal_length=None), None, "mla_shape = "),
    (cases.BOARD, START, CENTRES, "does not shift its odd rows"),
])  # fmt: skip
def test_other_boards_cameras_and_lattices_are_refused(table, centres, board, start, given, words):
    refuses(words, calibrate, table, board, start, given or centres)


def corners_of(folder, text):
    (folder / "corners.csv").write_text(text)
    return read_corners(folder / "corners.csv", cases.BOARD, (64, 64))


COLUMNS = "k,l,u,v,cluster,frame\n"

test_files_and_boards_are_refused = refused(
    (lambda folder: corners_of(folder, ""), "corners.csv: it has no column k"),
    (lambda folder: corners_of(folder, "k,l,u,v,cluster\n1,1,1,1,1\n"), "no column frame"),
    (lambda folder: corners_of(folder, COLUMNS), "no rows"),
    (lambda folder: corners_of(folder, f"{COLUMNS}1,1,nan,1,1,1\n"), "row 2: u = nan"),
    (lambda folder: corners_of(folder, f"{COLUMNS}1,1,1,1,99,1\n"), "cluster = 99"),
    *((lambda board=board: Board.parse(board, 10.0), "board") for board in ("9", "9x1", "9x5x3")),
    (lambda folder: read_camera(large(folder / "camera.json")), f"camera.json: {LARGE}"),
    (lambda folder: read_corners(large(folder / "corners.csv"), cases.BOARD, (64, 64)), f"corners.csv: {LARGE}"),
    (lambda folder: read_centres(large(folder / "centres.csv")), f"centres.csv: {LARGE}"),
    (lambda folder: read_centres(large(folder / "white.grid.json")), f"white.grid.json: {LARGE}"),
)


def some(table, part):
    return table.keep(np.random.default_rng(0).random(len(table["k"])) < part)


@pytest.mark.slow
def test_corners_that_leave_predictions_open_are_refused():
    """As frames that disagree about the camera by pixels do; by less, the stated deviation is that from the truth."""
    table = some(cases.corners(0.1)[0], 0.15)
    found = calibrate(bent_frames(table, 1.0), cases.BOARD, START)
    error = cal.evaluate(cases.corners()[0], cases.BOARD, found.camera).error
    assert error / 2 < found.prediction_deviation < 2 * error
    with pytest.raises(InputError, match=r"open where .* in other poses, \+- "):
        calibrate(bent_frames(table, 4.0), cases.BOARD, START)


@pytest.mark.slow
def test_the_command_names_what_corners_leave_open(tmp_path, run):
    table = cases.corners(0.5)[0]
    few = some(table.keep(table["frame"] < 13), 0.15)
    path, start, output = (tmp_path / name for name in ("corners.csv", "start.json", "camera.json"))
    rows = np.column_stack(list(few.columns.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(few.columns), comments="")
    start.write_text(START.to_json())
    printed = run("calibrate", "boards", path, "--board", "6x4", "--square", "6", "--camera", start, "-o", output)
    assert "leave the focal length open; with +" in printed and "go mla_distance +" in printed
    assert "boards in other poses are predicted to 0." in printed
    record = json.loads(output.read_text())["calibration"]
    assert record["open_direction"]["mla_distance"] > 1 and 0.1 < record["prediction_deviation_px"] < 1


@pytest.mark.slow
def test_corners_alone_tell_where_micro_images_are(table, found):
    """Corners are seen through the pupil, so that micro-images lie about them."""
    alone = calibrate(table, cases.BOARD, START)
    assert not alone.open_direction
    assert abs(alone.numbers["focal_length"] - cases.CAMERA.focal_length) < 3 * alone.deviations["focal_length"]
    assert alone.deviations["focal_length"] > 2 * found.deviations["focal_length"]
    unit, given = found.index.unit(table["k"], table["l"]), {"pixel_size": 0.0055, "row_ratio": 0.75**0.5}
    numbers = (np.array(list(each.numbers.values())) for each in (found, alone))
    theirs, ours = (predict_centres(each, unit, **given)[0] for each in numbers)
    assert np.sqrt(((ours - theirs) ** 2).sum(1).mean()) < 1


@pytest.mark.skipif(not cases.REAL.is_dir(), reason="needs the data of a real camera")
def test_a_real_camera(tmp_path, run):
    start, output, corners = tmp_path / "start.json", tmp_path / "camera.json", cases.REAL / "corners.csv"
    text = (Path(__file__).parents[3] / "docs" / "guides" / "calibration.md").read_text()
    start.write_text(text.split("```json\n")[1].split("```")[0])
    board, centres = ["--board", "9x5", "--square", "10"], cases.REAL / "centres.csv"
    run("calibrate", "boards", corners, *board, "--camera", start, "--centres", centres, "-o", output)
    *_, last = run("calibrate", "evaluate", corners, "--camera", output, *board).splitlines()
    error, rest = last.removeprefix("reprojection error ").split(" ", 1)
    assert rest == "px over 12433 observations of 11 poses" and float(error) <= 0.965


@pytest.mark.skipif(not cases.REAL.is_dir(), reason="needs the data of a real camera")
def test_the_board_of_a_real_camera_is_bent():
    """Halves of the poses find one shape, with which lengths are surer and residuals smaller."""
    board, start = Board(9, 5, 10.0), PlenopticCamera.preset("raytrix")
    corners = read_corners(cases.REAL / "corners.csv", board, start.crop_size)
    centres, half = read_centres(cases.REAL / "centres.csv"), corners["frame"] % 2 == 0
    parts = [corners, corners.keep(half), corners.keep(~half)]
    every, even, odd = (cal.calibrate(part, board, start, centres, bent=True) for part in parts)
    assert every.evaluation.error < 0.905 and every.deviations["focal_length"] < 0.6
    assert np.ptp(every.board_heights) > 0.6
    np.testing.assert_allclose(even.board_heights, odd.board_heights, atol=0.2)
    for name in ("focal_length", "mla_distance", "detector_distance"):
        assert abs(even.numbers[name] - odd.numbers[name]) < 2 * np.hypot(even.deviations[name], odd.deviations[name])


@pytest.mark.skipif(not cases.REAL.is_dir(), reason="needs the data of a real camera")
def test_compote_cameras_are_read():
    # Errors of three poses by COMPOTE's own model, which distorts points, not rays.
    camera, index = read_camera(cases.REAL / "compote_intrinsics.json")
    assert index is None
    board = Board(9, 5, 10.0)
    table = read_corners(cases.REAL / "corners.csv", board, camera.crop_size)
    found = cal.evaluate(table.keep(np.isin(table["frame"], [0, 8, 14])), board, camera)
    np.testing.assert_allclose(found.pose_errors, [1.112, 0.802, 0.684], atol=0.03)
    assert len(read_centres(cases.REAL / "centres.csv")["k"]) > 26000


def test_lenses_are_counted_as_rows_are_shifted():
    places = cal.LensIndex(0.5, -1, (3, 1)).unit(np.array([3, 3, 3]), np.array([1, 2, 3]))
    np.testing.assert_array_equal(places, [[0, 0], [-0.5, -1], [0, -2]])


def test_mistakes(mistake, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(tmp_path_factory.mktemp("files"))
    for name in ("a.png", "w.png", "a.csv", "b.csv", "c.csv"):
        Path(name).write_text("k,l")
    mistake("calibrate white a.png --camera paper -o {out}.json --report {out}.json", "give a name that ends in .html")
    mistake("calibrate corners w.png -o {out}.csv --board 9x5 --square 3", "no such option: --square")
    mistake("calibrate corners a.png --board 4x3 -o {out}.csv", "give a white picture")
    mistake("calibrate centres a.png b.csv -o {out}.csv", "b.csv: it is text")
