"""Files of other programs: LFToolbox, mosaics, raw pictures of real cameras."""

import contextlib
import json
import math
import sys
from dataclasses import asdict

import h5py
import numpy as np
import pytest
import scipy.io
from foreign_files import write_matlab_7
from PIL import Image
from refusals import refused, refuses

from mitsuba_plenoptic import Capture, PlenopticCamera, decode, write_capture
from mitsuba_plenoptic import exchange as ex
from mitsuba_plenoptic.views import LensGrid, grid_of, refocus, white_image

CAMERA = PlenopticCamera(detector_width=0.4, resolution=(128, 96), mla_pitch=0.05, aperture_radius=4)


@pytest.fixture
def lf():
    """Decode random light: 3 rows of 4 colours... of views that differ everywhere."""
    image = np.random.default_rng(0).random((*CAMERA.shape, 3), dtype=np.float32) * white_image(CAMERA)[..., None]
    return decode(2.5 * image, camera=CAMERA)


class TestLFToolbox:
    @pytest.mark.parametrize(("precision", "levels"), [("uint8", 255), ("single", None)])
    def test_round_trip(self, lf, precision, levels, tmp_path):
        ex.write_lftoolbox(tmp_path / "a.mat", lf, precision=precision)
        back = ex.read_lftoolbox(tmp_path / "a.mat")
        assert back.dims == lf.dims
        with pytest.warns(UserWarning, match="1 of .* are below 0") if levels else contextlib.nullcontext():
            ex.write_lftoolbox(tmp_path / "b.mat", lf.where(lf < lf.max(), -1), precision=precision)
        step = 0 if levels is None else float(lf.max()) / levels / 2 * 1.01
        np.testing.assert_allclose(back.values, lf.values, atol=step + 1e-7)
        np.testing.assert_allclose(back.weight.values, lf.weight.values, atol=0 if levels is None else 0.51 / levels)
        np.testing.assert_array_equal(back.white.values, lf.white.values)
        for name in lf.dims:
            assert back[name].equals(lf[name])
        assert back.attrs == lf.attrs

    def test_what_matlab_finds(self, lf, tmp_path):
        ex.write_lftoolbox(tmp_path / "a.mat", lf)
        found = scipy.io.loadmat(tmp_path / "a.mat", simplify_cells=True)
        # LF(t, s, v, u, c): rows and columns of views first, then of pixels; weight last.
        assert found["LF"].dtype == np.uint16
        assert found["LF"].shape == (*lf.shape[:4], 4)
        j, i, row, column = 5, 3, 2, 4
        expected = np.round(lf.values[j, i, row, column] / lf.values.max() * 65535)
        assert found["LF"][j, i, row, column, :3].tolist() == expected.tolist()
        assert found["MaxLum"] == pytest.approx(float(lf.max()))
        model = found["LensletGridModel"]
        assert (model["UMax"], model["VMax"]) == (lf.sizes["s"], lf.sizes["t"])
        assert model["HSpacing"] == pytest.approx(CAMERA.micro_image_pitch / CAMERA.pixel_size)
        assert model["Orientation"] == "horz"
        # MATLAB's rows FirstPosShiftRow:2:end are those that are shifted: none.
        assert model["FirstPosShiftRow"] > model["VMax"]
        # The four middle lenses lie about the detector's middle, which is between MATLAB's pixels 64 and 65.
        assert model["HOffset"] + 3.5 * model["HSpacing"] == pytest.approx(64.5)

    @pytest.mark.parametrize("shifted", [0, 1, None])
    def test_grid_models_keep_their_rows(self, lf, shifted, tmp_path):
        grid = LensGrid((15.1, 13.2), (3.7, 4.4), (6, 8), 0.01, shifted)
        lf.attrs["grid"] = json.dumps(asdict(grid))
        ex.write_lftoolbox(tmp_path / "a.mat", lf)
        assert grid_of(ex.read_lftoolbox(tmp_path / "a.mat")) == grid
        # LFToolbox's own construction of the centres, counted from 1.
        m = scipy.io.loadmat(tmp_path / "a.mat", simplify_cells=True)["LensletGridModel"]
        v, u = np.mgrid[: int(m["VMax"]), : int(m["UMax"])] * np.array([m["VSpacing"], m["HSpacing"]])[:, None, None]
        u[int(m["FirstPosShiftRow"]) - 1 :: 2] += m["HSpacing"] / 2
        cosine, sine = math.cos(m["Rot"]), math.sin(m["Rot"])
        x, y = cosine * u - sine * v + m["HOffset"], sine * u + cosine * v + m["VOffset"]
        np.testing.assert_allclose(np.stack([x, y], axis=-1) - 0.5, grid.centres())

    def test_files_of_lftoolbox_itself_are_matlab_73(self, tmp_path):
        stored = np.random.default_rng(0).integers(0, 65536, (5, 5, 3, 4, 4), dtype=np.uint16)
        model = {"HSpacing": 14.3, "VSpacing": 12.4, "HOffset": 5, "VOffset": 6, "Rot": 0.002, "UMax": 4, "VMax": 3}

        def fill(file):
            file["LF"] = stored.transpose()
            group = file.create_group("LensletGridModel")
            for name, value in (model | {"FirstPosShiftRow": 2}).items():
                group[name] = np.array([[float(value)]])
            group["Orientation"] = np.array([[ord(letter)] for letter in "horz"], dtype=np.uint16)

        back = ex.read_lftoolbox(write_matlab_7(tmp_path / "a.mat", fill))
        assert back.dims == ("v", "u", "t", "s", "c")
        np.testing.assert_allclose(back.values, stored[..., :3] / 65535, rtol=1e-6)
        np.testing.assert_allclose(back.white.values, stored[..., 3] / 65535, rtol=1e-6)
        assert "camera" not in back.attrs
        assert grid_of(back) == LensGrid((14.3, 12.4), (4.5, 5.5), (3, 4), 0.002, 1)
        assert back.u.values.tolist() == [-2, -1, 0, 1, 2]

    def test_without_weights_black_views_have_none(self, tmp_path):
        stored = np.ones((3, 3, 4, 5, 3), dtype=np.uint8)
        stored[0, 0] = 0
        stored[1, 1, 2, 2] = 0
        scipy.io.savemat(tmp_path / "a.mat", {"LF": stored})
        weight = ex.read_lftoolbox(tmp_path / "a.mat").weight.values
        assert not weight[0, 0].any()
        assert weight.sum() == 8 * 20

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            ({"X": np.ones(3)}, "no variable LF"),
            ({"LF": np.ones((3, 3))}, r"shape \(3, 3\)"),
            ({"LF": np.ones((3, 3, 3, 3, 7))}, "1 to 4 channels"),
            ({"LF": np.ones((3, 3, 3, 3)), "Camera": "{}"}, "missing from the camera"),
            ({"LF": np.ones((3, 3, 3, 3)), "LensletGridModel": {"HSpacing": 1.0}}, "cannot be read"),
            *(
                ({"LF": wrong}, "not an array of numbers")
                for wrong in (np.array([[1, "a"]], object), np.ones((3, 3, 4, 4)) * 1j)
            ),
            *(
                (content, "it cannot be read as a light field: ")
                for content in (bytes(512), b"MATLAB 5.0".ljust(126) + b"IM" + b"x" * 100)
            ),
            (b"MATLAB 7.3 MAT-file" + bytes(1000), "cannot be read"),
        ],
    )
    def test_other_files_are_refused(self, content, words, tmp_path):
        path = tmp_path / "a.mat"
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            scipy.io.savemat(path, content)
        refuses(rf"a\.mat: .*{words}", ex.open_light_field, path)

    def test_damaged_missing_and_hostile(self, lf, tmp_path):
        path = tmp_path / "a.mat"
        refuses("no such file", ex.read_lftoolbox, path)
        ex.write_lftoolbox(path, lf)
        path.write_bytes(path.read_bytes()[:1000])
        refuses("cannot be read", ex.read_lftoolbox, path)
        # A header that claims a terabyte is refused before anything of the size is allocated.
        scipy.io.savemat(path, {"LF": np.ones((2, 2, 2, 2, 3), np.uint8)})
        raw = bytearray(path.read_bytes())
        sizes = raw.find(np.array([2, 2, 2, 2, 3], np.int32).tobytes())
        raw[sizes : sizes + 20] = np.array([2000, 2000, 500, 500, 3], np.int32).tobytes()
        path.write_bytes(raw)
        refuses("at most", ex.read_lftoolbox, path)
        write_matlab_7(
            path, lambda file: file.create_dataset("LF", (2, 10**6, 10**6, 9, 9), np.uint8, chunks=(1, 16, 16, 3, 3))
        )
        assert path.stat().st_size < 10_000
        refuses(r"shape .*: it would need .* GiB", ex.read_lftoolbox, path)


def test_damaged_attributes_are_refused(lf):
    for text in ("{", "[1]", 3):
        refuses("light field: its attribute camera", refocus, lf.assign_attrs(camera=text), 230.0)


class TestMosaics:
    def test_layouts(self, lf, tmp_path):
        views, (rows, columns) = lf.sizes["u"], lf.shape[2:4]
        for layout, place in (("lenses", (2 * views + 7, 3 * views + 5)), ("views", (7 * rows + 2, 5 * columns + 3))):
            path = tmp_path / "a.png"
            ex.write_mosaic(path, lf, layout=layout)
            assert Image.open(path).size == (views * columns, views * rows)
            picture, back = ex.read_picture(path), ex.read_mosaic(path, views, layout=layout)
            assert back.dims == lf.dims and "camera" not in back.attrs
            # 16 bits in sRGB are finer than this everywhere.
            np.testing.assert_allclose(picture[place], lf.values[7, 5, 2, 3] / lf.values.max(), atol=4e-5)
            np.testing.assert_allclose(back.values, lf.values / lf.values.max(), atol=4e-5)

    def test_eight_bits_grey_and_transparency(self, tmp_path):
        path = tmp_path / "grey.png"
        Image.fromarray(np.array([[0, 188], [255, 10]], np.uint8)).save(path)
        # (188/255 sRGB is 0.5029 linear; 10/255 is on the straight part: / 12.92)
        np.testing.assert_allclose(ex.read_picture(path), [[0, 0.5029], [1, 10 / 255 / 12.92]], atol=1e-4)
        np.testing.assert_allclose(ex.read_picture(path, linear=True), [[0, 188 / 255], [1, 10 / 255]], atol=1e-6)
        Image.fromarray(np.full((2, 2, 4), 255, np.uint8)).save(tmp_path / "clear.png")
        assert ex.read_picture(tmp_path / "clear.png").shape == (2, 2, 3)

    def test_refused(self, lf, tmp_path):
        ex.write_mosaic(tmp_path / "a.png", lf)
        refuses("not a whole number of 4 x 4", ex.read_mosaic, tmp_path / "a.png", 4)
        refuses("layout = 'rows'", ex.read_mosaic, tmp_path / "a.png", 3, layout="rows")
        refuses("views = 0", ex.read_mosaic, tmp_path / "a.png", 0)
        (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:500])
        (tmp_path / "c.png").write_text("no picture")
        for name in ("b.png", "c.png", "d.png"):
            refuses(name, ex.read_picture, tmp_path / name)


class TestFiles:
    def test_a_capture_is_decoded(self, lf, tmp_path):
        image, gain = white_image(CAMERA), np.linspace(0.8, 1.2, CAMERA.shape[1])
        write_capture(tmp_path / "raw.exr", Capture(0.5 * image * gain, CAMERA))
        write_capture(tmp_path / "white.exr", Capture(image * gain, CAMERA))
        assert ex.open_light_field(tmp_path / "raw.exr").values.max() == pytest.approx(0.6, rel=0.05)
        even = ex.open_light_field(tmp_path / "raw.exr", white=tmp_path / "white.exr")
        np.testing.assert_allclose(even.values[even.weight.values > 0], 0.5, rtol=1e-3)

    def test_labelled_files_that_are_none_are_refused(self, lf, tmp_path, monkeypatch):
        ex.save_light_field(tmp_path / "a.nc", lf)
        (tmp_path / "cut.nc").write_bytes((tmp_path / "a.nc").read_bytes()[:3000])
        lf.isel(u=0).to_netcdf(tmp_path / "view.nc", engine="scipy")
        with h5py.File(tmp_path / "hdf5.nc", "w") as file:
            file["x"] = 1.0
        refusals = {"cut.nc": "cannot be read", "view.nc": "dimensions", "hdf5.nc": "not NetCDF 3", "b.zarr": "no such"}
        for name, words in refusals.items():
            refuses(f"{name}: .*{words}", ex.open_light_field, tmp_path / name)
        monkeypatch.setitem(sys.modules, "zarr", None)
        refuses("pip install zarr", ex.save_light_field, tmp_path / "a.zarr", lf)
        assert not (tmp_path / "a.zarr").exists()

    @pytest.mark.parametrize("hexagonal", [False, True])
    def test_a_raw_picture_of_an_unknown_camera(self, hexagonal, tmp_path):
        # Micro-images 10.7 pixels wide, 13.6 apart, turned by 0.3 degrees, brighter on one side, in 16 bits.
        camera = PlenopticCamera(detector_width=1.6, resolution=(400, 400))
        down = math.sqrt(0.75) if hexagonal else 1.0
        grid = LensGrid((13.6, 13.6 * down), (-6, 4), (40, 34), math.radians(0.3), 1 if hexagonal else None)
        white = white_image(camera, grid) * np.linspace(0.5, 0.9, 400, dtype=np.float32)
        # What it sees: brightness rises across the field.
        x = np.linspace(0.2, 1.0, 400, dtype=np.float32)
        for name, image in (("white.png", white), ("raw.png", white * x)):
            # IEC 61966-2-1
            codes = np.where(image <= 0.0031308, 12.92 * image, 1.055 * image ** (1 / 2.4) - 0.055)
            Image.fromarray(np.round(65535 * codes).astype(np.uint16)).save(tmp_path / name)
        lf = ex.open_light_field(tmp_path / "raw.png", white=tmp_path / "white.png")
        ex.save_light_field(tmp_path / "lf.mat", lf)
        back = ex.read_lftoolbox(tmp_path / "lf.mat")
        assert grid_of(back).rotation == pytest.approx(math.radians(0.3), abs=2e-4)
        middle = back.isel(v=back.sizes["v"] // 2, u=back.sizes["u"] // 2).values[4:-4, 4:-4]
        # From lens to lens brightness rises by that of one pixel times the side of a lens's cell.
        slope = np.diff(middle, axis=1).mean() / (13.6 * math.sqrt(down))
        assert slope / middle.mean() == pytest.approx(0.8 / 399 / 0.6, rel=0.02)
        assert np.abs(np.diff(middle, axis=0)).max() < 0.01


test_refused = refused(
    (lambda folder: ex.open_light_field(folder / "a.jpg"), "ends in"),
    (lambda folder: ex.open_light_field(folder / "a.tif"), "no such file"),
    (lambda folder: ex.open_light_field(folder / "a.png", white="w.png", views=3), "exclude"),
    (lambda folder: ex.open_light_field(folder / "a.exr", views=3), "views = 3"),
    (lambda folder: ex.open_light_field(folder / "a.mat", white="w.png"), "white = w.png"),
)
