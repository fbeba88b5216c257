"""Captures, light fields and scenes from strangers: they run nothing, and pixels take no more than memory."""

import contextlib
import json
import os
import shutil
import struct
import subprocess
import time
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import xarray as xr
from cameras import SMALL_SENSOR, write_scene
from foreign_files import LARGE, large, png, write_exr_parts
from refusals import refused, refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.io import read_labelled_data, versions, write_labelled_data
from mitsuba_plenoptic.io.pictures import read_picture
from mitsuba_plenoptic.refocus import Volume, write_volume
from mitsuba_plenoptic.views.light_field_files import open_light_field, save_light_field

CAMERA = mp.PlenopticCamera(resolution=(64, 64), detector_width=0.256)


@pytest.fixture
def capture(tmp_path):
    path = tmp_path / "raw.exr"
    mp.write_capture(path, mp.Capture(np.ones((64, 64)), CAMERA, metadata={"scene": "white.xml"}))
    return path


test_the_size_of_a_file_is_judged_before_it_is_read = refused(
    (lambda folder: mp.Spectrum.sensor(large(folder / "responses.csv")), f"responses.csv: {LARGE}"),
    (lambda folder: mp.read_prescription(large(folder / "lens.yaml")), f"lens.yaml: {LARGE}"),
    (lambda folder: mp.load_scene(large(folder / "scene.xml")), f"scene.xml: {LARGE}"),
)


def test_pictures_are_judged_by_the_memory_that_is_allowed(tmp_path, monkeypatch):
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", "4")
    refuses(r"a.tiff: 3221225472 bytes: it would need 6.0 GiB", mp.read_capture, large(tmp_path / "a.tiff"))


class TestCaptures:
    def test_a_header_that_claims_more_than_the_file_holds(self, capture):
        data = capture.read_bytes()
        place = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
        capture.write_bytes(data[:place] + struct.pack("<iiii", 0, 0, 2**30 - 1, 2**30 - 1) + data[place + 16 :])
        start = time.process_time()
        refuses(r"raw\.exr", mp.read_capture, capture)
        assert time.process_time() - start < 10

    def test_a_small_file_cannot_unpack_into_more_than_is_allowed(self, tmp_path, monkeypatch):
        path = tmp_path / "bomb.exr"
        header = {"mitsuba_plenoptic": "{}", "compression": OpenEXR.ZIP_COMPRESSION}
        OpenEXR.File(header, {"Y": np.zeros((4000, 4000), np.float32)}).write(str(path))
        assert path.stat().st_size < 4000 * 4000 * 4 / 100
        monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", "0.05")
        refuses(r"4000 x 4000 pixels of 1 channels: it would need 0\.1 GiB", mp.read_capture, path)

    @pytest.mark.parametrize(
        ("kind", "keeps_all"), [(OpenEXR.PIZ_COMPRESSION, True), (OpenEXR.PXR24_COMPRESSION, False)]
    )
    def test_other_programs_may_pack_it_anew_without_loss(self, capture, kind, keeps_all):
        image = np.random.default_rng(0).random((64, 64), dtype=np.float32)
        mp.write_capture(capture, mp.Capture(image, CAMERA))
        with OpenEXR.File(str(capture)) as file:
            text = file.header()["mitsuba_plenoptic"]
        OpenEXR.File({"mitsuba_plenoptic": text, "compression": kind}, {"Y": image}).write(str(capture))
        if keeps_all:
            np.testing.assert_array_equal(mp.read_capture(capture).image, image)
            OpenEXR.File({"mitsuba_plenoptic": text, "compression": kind}, {"Y": 2 * image}).write(str(capture))
            refuses(r"raw\.exr: its digest, .*another program has changed it", mp.read_capture, capture)
        else:
            refuses("lossy or unknown", mp.read_capture, capture)

    @pytest.mark.parametrize("text", ["!!python/object/apply:os.system ['touch hacked']", '{"a":' * 100_000])
    def test_a_header_is_data_not_code(self, tmp_path, monkeypatch, text):
        monkeypatch.chdir(tmp_path)
        OpenEXR.File({"mitsuba_plenoptic": text}, {"Y": np.zeros((4, 4), np.float32)}).write("evil.exr")
        refuses(r"evil\.exr", mp.read_capture, "evil.exr")
        assert [item.name for item in tmp_path.iterdir()] == ["evil.exr"]

    def test_no_name_of_a_header_becomes_a_path(self, tmp_path, run):
        """Names in the header that look like paths stay text: only the named outputs are written."""
        folder = tmp_path / "in" / "deep"
        folder.mkdir(parents=True)
        evil = {"scene": "../../evil", "output": "/tmp/evil", "view": "../x", "key": "../../k"}
        path = folder / "raw.exr"
        mp.write_capture(path, mp.Capture(np.ones((64, 64)), CAMERA, 633.0, "wave", evil))
        before = set(tmp_path.rglob("*"))
        run("views", path, "-o", folder / "views.exr", "--count", 2)
        run("reconstruct", path, "-o", folder / "r.exr", "--distance", 210, "--distance", 240)
        run("expose", path, "-o", folder / "e.exr", "--photons", 100)
        new = {item.relative_to(folder).as_posix() for item in {*tmp_path.rglob("*")} - before}
        assert new == {"views.exr", "r_210.exr", "r_240.exr", "e.exr"}

    def test_a_terminal_is_told_nothing_but_text(self, tmp_path, run):
        path = tmp_path / "raw.exr"
        evil = "\x1b]0;title\x07\x1b[2J\rline\nline\u202e"
        mp.write_capture(path, mp.Capture(np.ones((64, 64)), CAMERA, metadata={"scene": evil, evil: 1, "list": [evil]}))
        said = run("info", path)
        assert "title" in said
        assert all(character.isprintable() or character == "\n" for character in said)

    @pytest.mark.parametrize(("part", "change", "words"), [
        (0, {"normal.X": 0}, "whole quantities"),
        (1, {"shape_index.I": np.nan}, "whole number from 0 to 1"),
        (None, {"views": [1, 2, 3]}, "views = "),
        (None, {"views": [1, 2, 4, 10**9]}, "its part views has the shape"),
        (None, {"shapes": "wall"}, "shapes = 'wall'"),
        (None, {"kind": "capture"}, "it holds a 'capture', not ground truth"),
    ])  # fmt: skip
    def test_ground_truth_that_cannot_be(self, tmp_path, part, change, words):
        path, attributes = tmp_path / "a.truth.exr", {
            "kind": "ground truth", "camera": CAMERA.to_dict(), "views": [2, 2, 4, 4], "shapes": ["wall"],
            "to_world": np.eye(4).tolist(),
        }  # fmt: skip
        sizes = [CAMERA.shape, (8, 8)]
        planes = [{name: np.ones(size) for name in ("depth.Z", "shape_index.I")} for size in sizes]
        if part is None:
            attributes |= change
        else:
            planes[part] |= {name: np.full(sizes[part], value) for name, value in change.items()}
        write_exr_parts(path, dict(zip(("capture", "views"), planes, strict=True)), attributes)
        refuses(words, mp.read_ground_truth, path)
        assert main(["views", str(path), "-o", str(tmp_path / "views.exr")]) == 2

    def test_a_pipe_or_a_device_is_no_file(self, tmp_path):
        os.mkfifo(tmp_path / "raw.exr")
        for path in (tmp_path / "raw.exr", Path("/dev/zero"), tmp_path):
            refuses(r"not a regular file|it is a folder", mp.read_capture, path)
        refuses("device or a pipe", mp.write_capture, "/dev/null", mp.Capture(np.ones((64, 64)), CAMERA))


def labelled(path):
    """Write data of the kind that a name stands for; return the reader."""
    pixels = np.random.default_rng(1).random((64, 64), np.float32)
    if path.suffix == ".zarr":
        pytest.importorskip("zarr")
    if path.stem == "volume":
        about = {"camera": CAMERA.to_dict(), "facts": [{"planes": 2}]}
        write_volume(path, Volume(pixels.reshape(4, 32, 32), (210.0, 220.0, 230.0, 250.0), 0.03, about))
    elif path.stem == "particles":
        particles = pytest.importorskip("mitsuba_plenoptic.particles")
        box, flow = particles.ParticleVolume((-1, -1, 238), (1, 1, 242)), particles.Uniform((0.5, 0, 0))
        seeding = particles.Seeding(count=9)
        write_labelled_data(path, particles.particle_sequence(CAMERA, box, seeding, flow, interval=0.1, frames=2))
    else:
        save_light_field(path, mp.decode(np.stack([pixels, pixels**2, pixels**3], -1), camera=CAMERA))
        return open_light_field
    return read_labelled_data


class TestLightFields:
    def test_records_of_zarr_have_an_end(self, tmp_path, monkeypatch):
        pytest.importorskip("zarr")
        path = tmp_path / "lf.zarr"
        xr.Dataset({"radiance": ("s", np.ones(4))}).to_zarr(path, zarr_format=2)
        record = json.loads((path / "radiance" / ".zarray").read_text())
        (path / "radiance" / ".zarray").write_text(json.dumps({**record, "shape": [10**12], "chunks": [10**12]}))
        for file in path.rglob(".zmetadata"):
            file.unlink()
        refuses("a light field: it would need", open_light_field, path)

    @pytest.mark.parametrize("name", ["lf.nc", "lf.zarr", "volume.zarr", "particles.nc"])
    def test_flipped_bits_change_no_value(self, tmp_path, name):
        """Refused, or without effect: values, coordinates, types and attributes alike."""
        path, read = tmp_path / name, labelled(tmp_path / name)
        whole, random = read(path), np.random.default_rng(3)
        files = [file for file in sorted(path.rglob("*") if path.is_dir() else [path]) if file.is_file()]
        refusals = 0
        for number in range(60):
            file = files[number % len(files)]
            data = bytearray(content := file.read_bytes())
            data[random.integers(len(data))] ^= 1 << random.integers(8)
            file.write_bytes(data)
            try:
                same = read(path).identical(whole)
            except mp.InputError as error:
                refusals, same = refusals + (name in str(error)), name in str(error)
            assert same, (file, number)
            file.write_bytes(content)
        assert read(path).identical(whole) and refusals > 14

    def test_files_without_a_digest_or_of_another_version_are_read_and_changed_ones_are_not(
        self, tmp_path, monkeypatch
    ):
        path, read = tmp_path / "lf.nc", labelled(tmp_path / "lf.nc")
        data = xr.load_dataset(path)
        monkeypatch.setattr(versions, "VERSION", "3.0")
        assert read(path).weight.equals(data.weight)
        changed = data.assign_coords(weight=0.5 * data.weight)
        changed.to_netcdf(path, engine="scipy")
        refuses(r"lf\.nc: its digest, .*another program has changed it", read, path)
        changed.drop_attrs(deep=False).to_netcdf(path, engine="scipy")
        assert read(path).weight.max() == 0.5 * data.weight.max()

    def test_newer_formats_are_refused_and_newer_versions_read(self, tmp_path, monkeypatch):
        capture = mp.Capture(np.ones((64, 64)), CAMERA)
        monkeypatch.setattr(versions, "VERSION", "1.9.0")
        mp.write_capture(tmp_path / "raw.exr", capture)
        assert np.array_equal(mp.read_capture(tmp_path / "raw.exr").image, capture.image)
        with monkeypatch.context() as later:
            later.setattr(versions, "FORMAT", 2)
            mp.write_capture(tmp_path / "raw.exr", capture)
        refuses(r"raw\.exr: format = 2, of version 1\.9\.0", mp.read_capture, tmp_path / "raw.exr")

    def test_a_picture_that_claims_more_than_memory(self, tmp_path):
        path = tmp_path / "bomb.png"
        path.write_bytes(png(100_000, 100_000))
        refuses("it would need", read_picture, path)


class TestScenes:
    def test_native_code_beside_a_scene_is_not_run(self, tmp_path):
        (tmp_path / "plugins").mkdir()
        (tmp_path / "plugins" / "EVIL.DLL").write_bytes(b"")
        refuses("would run the native code", mp.load_scene, write_scene(tmp_path))

    @pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
    def test_a_library_of_a_stranger_is_never_loaded(self, tmp_path):
        """What Mitsuba does with such a scene, and we do not let it."""
        source, mark = tmp_path / "evil.c", tmp_path / "loaded"
        source.write_text(
            "#include <stdio.h>\n__attribute__((constructor)) static void run(void)"
            f'{{ FILE *f = fopen("{mark}", "w"); if (f) fclose(f); }}'
        )
        folder = tmp_path / "elsewhere" / "plugins"
        folder.mkdir(parents=True)
        subprocess.run(["cc", "-shared", "-fPIC", "-o", folder / "evil.so", source], check=True)
        (tmp_path / "inner.xml").write_text(f'<scene version="3.0.0"><path value="{folder.parent}"/></scene>')
        for text in (
            f'<path value="{folder.parent}"/><shape type="evil"/>',
            '<path value="elsewhere"/><default name="kind" value="evil"/><shape type="$kind"/>',
            '<include filename="inner.xml"/><shape type="evil"/>',
        ):
            refuses("would run the native code", mp.load_scene, write_scene(tmp_path, text))
        for name in ("elsewhere/plugins/evil", "../evil", str(folder / "evil")):
            refuses("must be the name of a plugin", mp.load_scene, write_scene(tmp_path, f'<shape type="{name}"/>'))
            with pytest.raises(mp.InputError, match="must be the name of a plugin"):
                text = '<default name="kind" value="sphere"/><shape type="$kind"/>'
                mp.load_scene(write_scene(tmp_path, text), parameters={"kind": name})
        assert not mark.exists()

    def test_an_include_is_judged_as_the_scene_is(self, tmp_path):
        (tmp_path / "inner.xml").write_text('<scene version="3.0.0"><shape></scene>')
        with pytest.raises(mp.InputError, match=r"inner\.xml, line 1: "):
            mp.load_scene(write_scene(tmp_path, '<default name="x" value="inner"/><include filename="$x.xml"/>'))
        refuses(r"scene\.xml", mp.load_scene, write_scene(tmp_path, '<include filename="scene.xml"/>'))

    @pytest.mark.parametrize(("left", "words"), [(7, None), (-1, "data window.* .-1, 0.")])
    def test_windows_of_exr_pictures(self, tmp_path, left, words):
        window = np.array([left, 0], np.int32), np.array([left + 7, 3], np.int32)
        header = {"dataWindow": window, "displayWindow": window, "compression": OpenEXR.PXR24_COMPRESSION}
        OpenEXR.File(header, {"Y": np.ones((4, 8), np.float32)}).write(str(tmp_path / "x.exr"))
        texture = '<texture name="reflectance" type="bitmap"><string name="filename" value="x.exr"/></texture>'
        path = write_scene(tmp_path, f'<bsdf type="diffuse">{texture}</bsdf>')
        with pytest.raises(mp.InputError, match=words) if words else contextlib.nullcontext():
            mp.load_scene(path)

    def test_a_scene_of_radiance_nan_makes_no_capture(self, tmp_path, complaint):
        light = '<emitter type="constant"><spectrum name="radiance" value="nan"/></emitter>'
        path, output = write_scene(tmp_path, light, sensor=SMALL_SENSOR), tmp_path / "raw.exr"
        for model in ("ray", "wave"):
            assert "finite" in complaint("render", path, "-o", output, "--spp", 1, "--model", model)
            assert not output.exists()
