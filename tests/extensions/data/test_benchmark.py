"""The benchmark: the same bits however it was made, truth by closed forms, and scores that are known beforehand."""

from __future__ import annotations

import configparser
import json
import math
import shutil

import mitsuba as mi
import numpy as np
import pytest
from foreign_files import write_exr_parts

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.benchmark import (
    BASELINES,
    CAMERAS,
    CAPTURES,
    DISTANCES,
    PUPIL_POINTS,
    SCENES,
    TASKS,
    Benchmark,
    Size,
    benchmark_recipe,
    depth_scores,
    export_hci,
    make_benchmark,
    picture_scores,
    run_baseline,
    score,
    table,
)
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.extensions.data import baselines
from mitsuba_plenoptic.extensions.data import dataset_production as production
from mitsuba_plenoptic.extensions.data.baselines import Question, _finer
from mitsuba_plenoptic.extensions.data.contents import capture_of, central_truth, view_image
from mitsuba_plenoptic.extensions.data.scenes import MIRROR, MIRRORED, Frame, SceneMaker
from mitsuba_plenoptic.report.metrics import relative_error

TINY = Size(8, 8, 1, 2)


@pytest.fixture(scope="module", autouse=True)
def two_cameras():
    with pytest.MonkeyPatch.context() as patch:
        for name in set(CAMERAS) - {"square", "hexagonal_other"}:
            patch.delitem(CAMERAS, name)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory, two_cameras):
    mi.set_variant("llvm_ad_mono")
    return make_benchmark(benchmark_recipe(3, ["mirror"], TINY), tmp_path_factory.mktemp("bench") / "made")


@pytest.fixture
def perfect(made, tmp_path):
    """Answers of the truth itself to two kinds of captures."""
    folder = tmp_path / "perfect"
    for index in made.entries():
        sample = made[index]
        truth = central_truth(sample)
        answers = {
            "depth": truth["virtual_depth"],
            "refocus": sample.arrays["target_refocus"],
            "views": sample.arrays["target_views"],
        }
        for capture in ("ray", "wave_dim"):
            place = folder.joinpath(*made.name(index), capture)
            place.mkdir(parents=True)
            for name, array in answers.items():
                np.save(place / f"{name}.npy", array)
    return folder


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class KilledError(Exception):
    """Stands in for the end of a process."""


@pytest.mark.slow
def test_a_run_that_was_killed_twice_ends_with_the_same_bits(made, tmp_path, monkeypatch):
    write, writes = production.write_samples, []

    def stopping(path, samples):
        writes.append(path)
        if len(writes) in (2, 4):
            raise KilledError
        write(path, samples)

    monkeypatch.setattr(production, "write_samples", stopping)
    for _ in range(2):
        with pytest.raises(KilledError):
            make_benchmark(benchmark_recipe(3, ["mirror"], TINY), tmp_path / "again")
    make_benchmark(benchmark_recipe(3, ["mirror"], TINY), tmp_path / "again")
    assert files(tmp_path / "again") == files(made.folder)
    with pytest.raises(InputError, match=r"recipe\.seed was 3, is 4"):
        make_benchmark(benchmark_recipe(4, ["mirror"], TINY), tmp_path / "again")


def test_samples_hold_what_the_card_says(made):
    sample = made[1]
    assert made.name(1) == ("mirror", "hexagonal_other") and len(made) == 4 and made.entries() == [0, 1]
    assert sample.facts["draws"]["split"] == "held_out" and made[0].facts["draws"]["split"] == "training"
    assert {*CAPTURES, "target_refocus", "target_views", "views_normal"} <= set(sample.arrays)
    card = (made.folder / "README.md").read_text()
    assert all(f"| `{name}` | {' x '.join(map(str, array.shape))} |" in card for name, array in made[0].arrays.items())
    assert "CC BY 4.0" in card and "seed 3" in card and made.damaged() == []
    dim = capture_of(sample, "wave_dim")
    assert dim.model == "wave" and dim.wavelength == 633 and dim.metadata["exposure"]["photons"] == 200
    # Noise leaves the mean as it is.
    assert dim.image.mean() == pytest.approx(sample.arrays["wave"].mean(), rel=0.02)
    lit = mp.views.white_image(made.white(1, "ray").camera) > 0.99
    assert made.white(1, "ray").image[lit].mean() == pytest.approx(1, abs=0.02)


def test_the_mirror_has_the_virtual_depth_of_the_closed_form(made):
    truth = central_truth(made[0])
    mirror = truth["virtual_depth"] > truth["depth"]
    assert 0.2 < mirror.mean() < 0.8
    # The panel's image is a plane across the axis, those of the cards are before it.
    image = truth["virtual_depth"][mirror]
    panel = np.isclose(image, MIRROR + MIRRORED, rtol=1e-5)
    assert panel.mean() > 0.6
    np.testing.assert_allclose(
        np.sort(MIRROR + MIRRORED - np.unique(np.round(image[~panel], 2))), [5, 10][:2], rtol=1e-3
    )
    assert np.abs(truth["depth"][mirror] - MIRROR).max() < 1


@pytest.mark.parametrize("name", SCENES)
def test_scenes_lie_where_cameras_resolve_depth_and_follow_from_the_seed(name):
    mi.set_variant("llvm_ad_mono")
    camera = mp.PlenopticCamera(detector_width=0.512, resolution=(64, 64))
    found = []
    for seed in (0, 1):
        scene = mp.load_scene(SceneMaker(name, seed, Frame(0.512 / 120, 8)).scene(camera, None, None))
        truth = mp.ground_truth(mp.with_camera(scene, camera), ["virtual_depth", "normal"])
        found.append(truth.views["normal"])
        depth = truth.views["virtual_depth"][3, 3]
        assert depth.min() > 220 and depth.max() < 266 and np.ptp(depth) > 1
    assert name == "repeated" or not np.array_equal(*found, equal_nan=True)


def test_views_leave_the_plane_in_focus_in_place():
    mi.set_variant("llvm_ad_mono")
    camera = mp.PlenopticCamera(detector_width=0.512, resolution=(64, 64))
    frame = Frame(0.512 / 120, 8)
    card = frame.card(np.random.default_rng(1), 0, 0, camera.focus_distance, 2.0)
    # A thing behind it moves with the pupil, +x to the left, by the fraction of its distance that is behind the focus.
    pixels, pixel = 2, camera.bin_size(camera.focus_distance) / 2
    behind = camera.focus_distance / (1 - pixels * pixel / (0.5 * camera.aperture_radius))
    far = frame.card(np.random.default_rng(1), 0, 0, behind, 2.0)
    light = {"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant"}}
    for thing, moved in ((card, 0), (far, pixels)):
        scene = mp.with_camera(mp.load_scene({**light, "card": thing}), camera)
        central, left, below = (view_image(scene, camera, point, 128) for point in ((0, 0), (0.5, 0), (0, -0.5)))
        assert central.std() > 0.05
        pairs = (left[:, : 16 - moved], central[:, moved:]), (below[moved:], central[: 16 - moved])
        assert all(relative_error(*pair) < 0.04 for pair in pairs)
        if moved:
            assert relative_error(left, central) > 0.15 < relative_error(below, central)


def test_the_truth_is_scored_as_perfect(made, perfect):
    rows = score(made, perfect)
    assert len(rows) == 2 * 2 * 3
    for row in rows:
        scores = row["scores"]
        if row["task"] == "depth":
            assert scores["bad_1"] == scores["bad_7"] == scores["rmse"] == 0 and scores["known"] == 1
            assert scores["mirror_bad_3"] == 0 and scores["mirror_surface_bad_3"] > 0.6
        else:
            assert scores["psnr"] == 100 and (math.isnan(scores["ssim"]) or scores["ssim"] == pytest.approx(1))


def test_depths_that_are_off_have_the_errors_of_closed_forms():
    depth = np.full((16, 16), 240.0)
    virtual, glass = depth.copy(), np.zeros((16, 16), bool)
    virtual[:, 12:] = 264.0
    glass[:, :4] = True
    truth = {"depth": depth, "virtual_depth": virtual, "glass": glass}
    moved = 1.02 * depth
    moved[:8] = np.nan
    found = depth_scores(moved, truth)
    # Half of the bins are unknown, the others off by 2 %.
    assert (found["bad_1"], found["bad_3"], found["bad_7"], found["known"]) == (1, 0.5, 0.5, 0.5)
    assert found["rmse"] == pytest.approx(0.02)
    assert (found["mirror_bad_3"], found["mirror_surface_bad_3"]) == (1, 0.5)
    # What is in glass, or at the border, counts nothing.
    moved = depth.copy()
    moved[:, :4] = moved[0] = np.inf
    assert depth_scores(moved, truth)["bad_1"] == 0
    # Numbers whose squares are infinite have finite errors.
    assert depth_scores(np.full((16, 16), 2.4e302), truth)["rmse"] == pytest.approx(1e300)
    nothing = depth_scores(moved, {**truth, "virtual_depth": depth})
    assert math.isnan(nothing["mirror_bad_3"])


def test_pictures_that_are_off_have_the_ratio_of_the_closed_form():
    truth = np.random.default_rng(0).uniform(0.2, 0.8, (2, 16, 16))
    found = picture_scores(truth + 0.1, truth)
    assert found["psnr"] == pytest.approx(20) and 0.5 < found["ssim"] < 1
    # Beyond white nothing is compared, and what is missing is black.
    assert picture_scores(truth + 5, np.ones_like(truth))["psnr"] == 100
    assert picture_scores(np.full_like(truth, np.nan), np.full_like(truth, 0.1))["psnr"] == pytest.approx(20)
    assert picture_scores(truth[:, ::-1], truth)["ssim"] < 0.3


@pytest.mark.parametrize("suffix", [".nc", ".exr"])
def test_answers_may_have_other_formats(made, perfect, suffix):
    import xarray as xr

    for path in list(perfect.rglob("*.npy")):
        array = np.load(path).astype(np.float32)
        if suffix == ".nc":
            xr.DataArray(array).to_netcdf(path.with_suffix(suffix), engine="scipy")
        else:
            planes = {"": {"Y": array.reshape(-1, array.shape[-1])}}
            write_exr_parts(path.with_suffix(suffix), planes, {})
        path.unlink()
    assert all(row["scores"].get("psnr", 100) == 100 for row in score(made, perfect))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.unlink(), r"mirror/square/ray/depth\.npy: there is no such file"),
        (lambda path: np.save(path, np.ones((4, 8))), r"depth\.npy: its shape is \(4, 8\): it must be \(8, 8\)"),
        (lambda path: np.save(path, np.ones((8, 8), complex)), "its type is complex128: it must be real"),
        (lambda path: np.save(path, np.array([{}])), r"depth\.npy: it cannot be read:"),
        (lambda path: path.write_bytes(b"nothing"), r"depth\.npy: it cannot be read:"),
        (
            lambda path: np.savez(path.with_suffix(""), np.ones((8, 8))) or path.with_suffix(".npz").replace(path),
            r"depth\.npy: it is an archive \(\.npz\): it must be one array$",
        ),
        (
            lambda path: path.rename(path.with_stem("dept")),
            r"ray/dept\.npy: task = 'dept': it must be .* did you mean depth",
        ),
        (
            lambda path: path.parent.rename(path.parents[1] / "rays"),
            r"capture = 'rays': it must be one of ray, ray_bri",
        ),
        (lambda path: shutil.rmtree(path.parents[3]), r"it has no answers: they are called SCENE/CAMERA/CAPTURE/TASK"),
    ],
)
def test_bad_answers_are_refused_in_one_line(made, perfect, change, message):
    change(perfect / "mirror/square/ray/depth.npy")
    with pytest.raises(InputError, match=message):
        score(made, perfect)


def test_the_table_ranks_by_the_main_score():
    def rows(value, ratio):
        about = {"capture": "ray", "scene": "a", "camera": "b", "split": "training"}
        yield {"task": "refocus", **about, "scores": {"psnr": ratio, "ssim": 0.5}}
        yield {"task": "depth", **about, "scores": {"bad_3": value, "known": math.nan}}

    scored = {"one": [*rows(0.5, 20), *rows(0.1, 30)], "two": [*rows(0.2, 20)], "three": [*rows(0.3, 25)]}
    depth, refocus = table(scored)
    assert (depth.task, refocus.task) == ("depth", "refocus")
    assert depth.means["one"]["bad_3"] == pytest.approx(0.3) and math.isnan(depth.means["one"]["known"])
    assert depth.ranks == {"two": 1, "one": 2, "three": 2} or depth.ranks["two"] == 1
    assert refocus.ranks == {"one": 1, "three": 1, "two": 3}


def test_interpolated_pictures_lie_on_the_finer_bins():
    row, column = np.indices((16, 16)) + 0.5
    fine = (np.indices((32, 32)) + 0.5) / 2
    found, expected = _finer(row - 2 * column), fine[0] - 2 * fine[1]
    np.testing.assert_allclose(found[8:-8, 8:-8], expected[8:-8, 8:-8], atol=5e-3)


def test_answers_that_are_there_twice_are_refused(made, perfect):
    path = perfect / "mirror/square/ray/depth.npy"
    path.with_suffix(".nc").write_bytes(path.read_bytes())
    with pytest.raises(InputError, match=r"ray/depth: there are 2 answers: depth\.npy, depth\.nc$"):
        score(made, perfect)


def test_the_command_runs_scores_and_exports(made, tmp_path, capsys):
    for name in ("plain", "ray"):
        assert main(["benchmark", "run", name, str(made.folder), "-o", str(tmp_path / name), "--capture", "ray"]) == 0
    output = tmp_path / "scores.json"
    capsys.readouterr()
    assert (
        main(
            ["benchmark", "score", str(made.folder), *(str(tmp_path / n) for n in ("plain", "ray")), "-o", str(output)]
        )
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["task", "captures", "cameras", "plain", "ray"] and len(lines) == 1 + 3 * 2
    content = json.loads(output.read_text())
    assert len(content["scores"]["ray"]) == 6 and len(content["means"]) == 6
    assert main(["benchmark", "run", "rays", str(made.folder), "-o", str(tmp_path / "x")]) == 2
    assert "'rays': it must be one of plain, ray, coherent" in capsys.readouterr().err
    assert main(["benchmark", "score", str(made.folder), str(tmp_path / "none"), "-o", str(output)]) == 2
    assert "none: it has no answers" in capsys.readouterr().err
    assert main(["benchmark", "make", "-o", str(tmp_path / "new"), "--scene", "mirrors"]) == 2
    assert "scenes = 'mirrors': it must be one of" in capsys.readouterr().err
    assert main(["benchmark", "export", str(made.folder), "-o", str(tmp_path / "hci")]) == 0


def test_white_captures_are_those_of_the_benchmark(made, monkeypatch):
    """Refocused once for each camera and model, and not those of another benchmark."""
    asked = []
    monkeypatch.setattr(baselines, "_images", lambda capture, **options: asked.append(capture) or np.ones((3, 8, 8)))
    for _ in range(2):
        run_baseline("coherent", made, made.folder.parent / "answers", ["wave", "wave_dim"])
    # Two captures by each of two cameras, and a white one for each camera.
    assert len(asked) == 2 * (4 + 2)
    whites = [made.white(index, "wave").image for index in made.entries()]
    assert sum(any(np.array_equal(each.image, white) for white in whites) for each in asked) == 4


def test_waves_are_divided_by_the_white_capture(made):
    sample = made[0]
    question = Question(capture_of(sample, "wave"), made.white(0, "wave"))
    (found,) = BASELINES["coherent"](question).values()
    assert found.shape == (len(DISTANCES), 8, 8)
    # Waves of few lenses interfere; on average they have the brightness of the truth, which the white capture gives.
    assert found[:, 1:-1, 1:-1].mean() == pytest.approx(sample.arrays["target_refocus"][:, 1:-1, 1:-1].mean(), rel=0.1)


def test_exported_light_fields_have_the_disparity_of_the_other_benchmark(made, tmp_path):
    place = export_hci(made, tmp_path, "wave")[0]
    read = configparser.ConfigParser()
    read.read(place / "parameters.cfg")
    inside, outside = read["intrinsics"], read["extrinsics"]
    maps = {}
    for name in ("gt_depth_lowres", "gt_disp_lowres"):
        head, size, scale, values = (place / f"{name}.pfm").read_bytes().split(b"\n", 3)
        assert (head, size, scale) == (b"Pf", b"8 8", b"-1")
        maps[name] = np.frombuffer(values, "<f4").reshape(8, 8)[::-1]
    depth, shift = maps.values()
    np.testing.assert_allclose(1000 * depth, central_truth(made[0])["virtual_depth"], rtol=1e-5)
    # The formula by which that benchmark turns depths, in metres, into disparities.
    factor = (
        float(outside["baseline_mm"]) / 1000 * float(inside["focal_length_mm"]) * 8 / float(inside["sensor_size_mm"])
    )
    np.testing.assert_allclose(shift, factor * (1 / depth - 1 / float(outside["focus_distance_m"])), atol=1e-4)
    views = int(outside["num_cams_x"])
    assert len(list(place.glob("input_Cam*.png"))) == views**2 and (place / f"input_Cam{views**2 - 1:03d}.png").exists()


def test_other_data_sets_are_refused(made, tmp_path):
    shutil.copytree(made.folder, tmp_path / "other")
    path = tmp_path / "other/dataset.json"
    content = json.loads(path.read_text())
    content["recipe"]["benchmark"] = 0
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="other: it is version 0: this program reads 1"):
        Benchmark(tmp_path / "other")
    del content["recipe"]["benchmark"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="it holds a data set that is no benchmark"):
        Benchmark(tmp_path / "other")
    assert set(TASKS) == {"depth", "refocus", "views"} and len(PUPIL_POINTS) == len(made[0].arrays["target_views"])


def test_the_network_is_answered_with_what_serves_instead():
    with pytest.raises(InputError, match=r"^baseline = network: it is gone since version 2\.0; use ray[^\n]*$"):
        run_baseline("network", None, "answers")
