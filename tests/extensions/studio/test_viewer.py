"""The viewer: its page holds the capture's values, states what it leaves out, and in a browser refocuses as we do."""

import base64
import dataclasses
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from cameras import white
from foreign_files import write_exr_parts
from PIL import Image
from refusals import refused

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Capture, PlenopticCamera, read_capture, reconstruct
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.extensions.studio import viewer
from mitsuba_plenoptic.extensions.studio.viewer import Recording
from mitsuba_plenoptic.report.images import encode, to_bytes
from mitsuba_plenoptic.views import depth_map, focal_stack, shift_and_add
from mitsuba_plenoptic.views import view as one_view

CAMERA = mp.PlenopticCamera(resolution=(256, 256), detector_width=1.024, crop_size=(256, 256))


def capture(camera=CAMERA, colour=False, seed=0):
    """Squares that are in focus at 1 / 2 lens a view."""
    rows, columns = camera.shape
    y, x = np.mgrid[0:rows, 0:columns]
    lens = x // 16 + 0.5 * (x % 16 - 7.5), y // 16 + 0.5 * (y % 16 - 7.5)
    image = ((lens[0] // 3 + lens[1] // 3) % 2) * 0.8 + 0.1 + 0.05 * np.random.default_rng(seed).random((rows, columns))
    return mp.Capture(np.stack([image, 0.5 * image, 1 - image], axis=-1) if colour else image, camera)


def content(page):
    """Return the data of a page, or of its file."""
    text = page.read_text() if isinstance(page, Path) else page.page
    return json.loads(text.split('<script type="application/json" id="data">')[1].split("</script>")[0])


def pixels(picture):
    """Return the values of a picture as the page reads them, NaN where it is transparent."""
    image = Image.open(io.BytesIO(base64.b64decode(picture["source"].partition(",")[2])))
    codes = np.asarray(image).astype(int)
    codes = codes.reshape(*codes.shape[:2], -1)
    if picture["bits"] == 16:
        half = len(codes) // 2
        opaque = codes[:half, :, picture["channels"] :]
        codes = (256 * codes[:half] + codes[half:])[..., : picture["channels"]]
        codes = np.concatenate([codes, opaque], axis=2)
    colours = codes[..., : picture["channels"]] / (2 ** picture["bits"] - 1)
    # IEC 61966-2-1
    values = picture["full"] * np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    return np.where(codes[..., picture["channels"] :].min(axis=2, initial=255, keepdims=True) > 0, values, np.nan)


@pytest.mark.parametrize(("bits", "error"), [(8, 0.005), (16, 2e-5)])
@pytest.mark.parametrize("colour", [False, True])
def test_pictures_hold_values(bits, error, colour):
    image = np.random.default_rng(1).random((5, 7, 3)) * 4
    image = image if colour else image[..., 0]
    found = pixels(encode(image, bits, 4.0))
    assert np.abs(found - image.reshape(5, 7, -1)).max() < 4 * error
    image[2, 3] = np.nan
    found = pixels(encode(image, bits, 4.0))
    assert np.isnan(found[2, 3]).all() and np.isnan(found).all(axis=2).sum() == 1


def test_the_page_holds_the_views():
    recorded = capture()
    lf = mp.decode(recorded)
    one = content(mp.view(recorded))["recordings"][0]
    assert one["name"] == "ray" and one["columns"] == lf.sizes["s"]
    views = pixels(one["views"])[..., 0].reshape(lf.sizes["v"], lf.sizes["t"], lf.sizes["u"], lf.sizes["s"])
    assert np.abs(views.transpose(0, 2, 1, 3) - lf.values).max() < 0.006 * one["views"]["full"]
    assert one["distances"][np.argmin(np.abs(one["disparities"]))] == pytest.approx(CAMERA.focus_distance, rel=1e-3)
    raw = one["raw"]
    assert pixels(raw["picture"])[..., 0] == pytest.approx(recorded.image, abs=0.006 * raw["picture"]["full"])
    assert raw["lenses"]["spacing"][0] == pytest.approx(CAMERA.micro_image_pitch / CAMERA.pixel_size)


def test_the_views_of_large_and_small_detectors_are_as_many():
    for lenses in (4, 64):
        camera = mp.PlenopticCamera(resolution=(20 * lenses,) * 2, detector_width=lenses * 0.064)
        one = content(mp.view(mp.Capture(np.ones(camera.shape), camera)))["recordings"][0]
        assert len(one["v"]) == len(one["u"]) == 11 and one["v"][5] == one["u"][5] == 0


def test_what_is_left_out_is_stated(monkeypatch):
    monkeypatch.setattr(viewer, "_VIEW_BYTES", 10_000)
    monkeypatch.setattr(viewer, "_RAW_BYTES", 20_000)
    page = mp.view(capture(colour=True))
    one = content(page)["recordings"][0]
    lf = mp.decode(capture(colour=True))
    assert len(one["v"]) == len(one["u"]) == 3 and one["v"][1] == one["u"][1] == 0
    assert f"3 x 3 of {lf.sizes['u']} x {lf.sizes['v']}, the others left out" in page.page
    assert one["raw"]["factor"] == 4 and "averaged over 4 x 4 pixels" in page.page
    # Bins are stated in pixels of the capture, whatever the page holds of it.
    assert one["raw"]["lenses"]["spacing"][0] == pytest.approx(CAMERA.micro_image_pitch / CAMERA.pixel_size)


def test_negative_samples_are_stated_and_bright_lamps_held_in_16_bits():
    recorded = capture()
    noisy = dataclasses.replace(recorded, image=recorded.image - 0.15)
    fraction = float((mp.decode(noisy).values < 0).mean())
    assert f"{fraction:.2%} of the samples are negative" in mp.view(noisy).page
    assert "are negative" not in mp.view(recorded).page
    recorded.image[96:112, 96:112] = 300
    one = content(mp.view(recorded))["recordings"][0]
    assert one["views"]["bits"] == 16 and one["views"]["full"] > 290
    assert pixels(one["views"])[..., 0].sum() == pytest.approx(float(mp.decode(recorded).sum()), rel=1e-3)


def test_stacks_and_depths():
    recorded = capture()
    lf = mp.decode(recorded)
    results = mp.reconstruct(recorded, [260.0, 240.0])
    unknown = dataclasses.replace(results[0], image=np.where(np.eye(16), np.nan, results[0].image))
    depth = depth_map(lf, 230, 250, planes=8)
    depth["depth"][:], depth["confidence"][:] = 235.0, 1.0
    depth["confidence"][0] = 0.0
    depth["depth"][1] = np.inf
    found = content(mp.view(recorded, unknown, results[1], depth))
    assert [plane["distance"] for plane in found["planes"]] == [240, 260]
    assert np.array_equal(np.isnan(pixels(found["planes"][1]["picture"])[..., 0]), np.eye(16) > 0)
    inverse = pixels(found["depth"]["picture"])[..., 0]
    assert np.isnan(inverse[0]).all() and (inverse[1] == 0).all()
    assert 1 / inverse[2:] == pytest.approx(235, rel=2e-4)
    # A stack alone is enough.
    alone = content(mp.view(focal_stack(lf, [230, 250])))
    assert alone["recordings"] == [] and [plane["method"] for plane in alone["planes"]] == ["shifted views"] * 2


def test_light_fields_without_a_camera():
    lf = mp.decode(capture())
    plain = xr.DataArray(lf.values, dims=lf.dims, coords={"weight": lf["weight"].variable}, name="radiance")
    steps = {axis: np.arange(lf.sizes[axis]) - (lf.sizes[axis] - 1) / 2 for axis in lf.dims}
    one = content(mp.view(plain.assign_coords(steps)))["recordings"][0]
    assert one["distances"] == [None] * len(one["disparities"]) and one["raw"] is None


def refocused(**options):
    return mp.reconstruct(capture(), [240.0], **options)


test_refused = refused(
    (lambda: mp.view(capture(), capture(colour=True)), "sources: .* shapes .* cannot be compared"),
    (lambda: mp.view(capture(), capture(CAMERA.replace(mla_distance=121.0))), "sources: .* whose v differ"),
    (lambda: mp.view(*refocused(), *refocused(oversample=2)), "sources: focal stack: .* one size"),
)


def opened(browser, path, **size):
    """Open a page, and return functions that find an element and its canvas, after the frame that follows an action."""
    seen = browser(path, **size)
    seen.implicitly_wait(20)
    seen.find_element("css selector", "main:not([aria-busy])")
    seen.implicitly_wait(0)

    def find(selector):
        seen.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")
        return seen.find_element("css selector", selector)

    def drawn():
        url = seen.execute_script("return arguments[0].toDataURL()", find("#field"))
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))))

    return seen, find, drawn


def likeness(image, white, drawn):
    """Return the PSNR in decibels of a canvas, which shows an image as `to_bytes` encodes it."""
    expected = to_bytes(np.asarray(image), white).astype(float)
    shown = drawn[..., : 3 if expected.ndim == 3 else 1].reshape(expected.shape)
    return 20 * np.log10(255 / np.sqrt(np.mean((expected - shown) ** 2) + 1e-9))


def test_a_stack_and_a_depth_map_in_a_browser(tmp_path, browser):
    results = mp.reconstruct(capture(), [240.0, 260.0])
    holed = dataclasses.replace(results[1], image=np.where(np.eye(16), np.nan, results[1].image))
    values = {"depth": 200.0, "confidence": 1.0, "image": 0.5}
    depth = xr.Dataset({name: (("t", "s"), np.full((16, 16), value)) for name, value in values.items()})
    depth["depth"][4:] = 400.0
    made = mp.view(results[0], holed, depth)
    made.save(tmp_path / "view.html")
    page, find, drawn = opened(browser, tmp_path / "view.html")
    assert find("#focus-text").text == "260 mm"
    assert not find("#pupil-panel").is_displayed() and not find("#raw-panel").is_displayed()
    assert np.array_equal(drawn()[..., 3] == 0, np.eye(16) > 0)
    find("#focus").send_keys("\ue012")  # arrow left
    assert likeness(results[0].image, content(made)["white"], drawn()) > 45
    find("input[value=depth]").click()
    shown = drawn()
    # Near is bright, and a click prints the depth.
    assert shown[:4, :, :3].mean() > 100 > shown[4:, :, :3].mean()
    find("#field").click()
    assert "depth 400 mm" in find("#readout").text
    assert page.get_log("browser") == []


def test_the_viewer_in_a_browser(tmp_path, browser):
    ray = capture()
    wave = dataclasses.replace(capture(seed=1), model="wave")
    made = mp.view(Recording("<b>", mp.decode(ray), ray.image), wave, title="A <b>")
    made.save(tmp_path / "view.html")
    page, find, drawn = opened(browser, tmp_path / "view.html")
    lf, data = mp.decode(ray), content(made)

    def alike(image):
        return likeness(image, data["white"], drawn())

    assert alike(one_view(lf)) > 40
    # Drag, as far as to the edge of the pupil, along u.
    before = find("#view-text").text
    page.execute_script("""
      const canvas = document.getElementById("field"), box = canvas.getBoundingClientRect();
      canvas.setPointerCapture = () => {};
      const send = (name, x) =>
        canvas.dispatchEvent(new PointerEvent(name, {clientX: x, clientY: box.top + 50, pointerId: 1}));
      send("pointerdown", box.left + 100); send("pointermove", box.left + 100 + box.width / 4); send("pointerup", 0);
    """)
    assert find("#view-text").text != before
    # Refocused, at another step of the slider.
    steps = data["recordings"][0]["disparities"]
    for step in (20, 120):
        page.execute_script(
            "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'))", find("#focus"), step
        )
        assert alike(shift_and_add(lf, steps[step])) >= 35
    # A click finds the disparity of the squares.
    page.execute_script("document.querySelector('input[value=view]').click()")
    find("#field").click()
    step = int(find("#focus").get_attribute("value"))
    assert abs(abs(steps[step]) - 0.5) < 0.06
    # The other capture, by keyboard, and the difference.
    find("input[value='1'][name=sources]").send_keys(" ")
    assert alike(shift_and_add(mp.decode(wave), steps[step])) >= 35
    find("input[value=difference]").click()
    assert "wave - <b>" in find("#field-tag").text and (drawn()[8, 8, :3] > 200).all()
    # From lens to lens.
    before = find("#lens-text").text
    find("#raw").send_keys("\ue014")  # arrow right
    assert find("#lens-text").text != before

    requested = page.execute_script("return performance.getEntriesByType('resource').map((one) => one.name)")
    assert all(name.startswith("data:") for name in requested)
    assert page.get_log("browser") == []
    assert_sliders_in_line(page, 2)
    for narrow in (320, 390):
        page, find, _ = opened(browser, tmp_path / "view.html", width=narrow, height=800)
        assert page.execute_script("return document.documentElement.scrollWidth") <= narrow
        # The map of viewpoints is next to the picture, and both are seen at once.
        field, pupil = (boxed(page, name) for name in ("field", "pupil"))
        assert pupil["left"] >= field["right"] and abs(pupil["top"] - field["top"]) < 4 and field["bottom"] < 800
        assert_sliders_in_line(page, 1)
        before = find("#view-text").text
        find("#pupil").send_keys("\ue012")  # arrow left
        assert find("#view-text").text != before
        assert page.get_log("browser") == []


def boxed(page, identity):
    return page.execute_script(f"return document.getElementById('{identity}').getBoundingClientRect().toJSON()")


def assert_sliders_in_line(page, columns):
    """Sliders of a column begin and end at the same places, and no label is broken into lines."""
    boxes = [boxed(page, name) for name in ("focus", "exposure", "span")]
    for end in ("left", "right"):
        assert len({round(box[end]) for box in boxes}) == columns
    labels = "[...document.querySelectorAll('.focus label')]"
    heights = page.execute_script(f"return {labels}.map((label) => label.getBoundingClientRect().height)")
    assert len({round(height) for height in heights}) == 1


@pytest.mark.parametrize("preset, width, spp, noise", [("paper_double_gauss", 0.512, 2, 1e-3), ("lfm", 1.2, 256, 0.1)])
def test_captures_by_real_lenses_and_microscopes(preset, width, spp, noise):
    """A sky of radiance 1 is 1 in all views, so that micro-images are where the page has them."""
    camera = mp.PlenopticCamera.preset(preset)
    pixels = round(width / camera.pixel_size)
    camera = camera.replace(detector_width=pixels * camera.pixel_size, resolution=(pixels, pixels))
    seen = mp.render_capture(white(camera), model="ray", spp=spp)
    lf = viewer.decoded(seen)
    assert "camera" not in lf.attrs and lf.attrs["grid"]
    middle = lf.sizes["v"] // 2
    for view_index in (middle, round(1.6 * middle)):
        part = lf.isel(v=middle, u=view_index, s=slice(1, -1), t=slice(1, -1))
        known = part.values[part["weight"].values > 0.5]
        assert len(known) == part.size
        assert known.mean() == pytest.approx(1, abs=0.05) and known.std() < noise
    (one,) = content(mp.view(seen))["recordings"]
    assert one["raw"]["rows"] == pixels and set(one["distances"]) == {None}


SMALL = PlenopticCamera(resolution=(64, 32), detector_width=0.256, crop_size=(64, 32))


def test_captures_and_reconstructions_are_pictures():
    text = Capture(np.ones((32, 64, 3)), SMALL, (611.0, 549.0, 464.0), "wave")._repr_html_()
    assert text.startswith('<figure><img src="data:image/png;base64,') and "(611.0, 549.0, 464.0) nm" in text
    shown = reconstruct(Capture(np.linspace(0, 1, 64) * np.ones((32, 1)), SMALL), [200, 240])._repr_html_()
    (scale,) = set(re.findall("white is [0-9.]+", shown))
    assert shown.count("<img") == 2 and len(scale) > 9


@pytest.mark.parametrize(("camera", "pictures"), [(SMALL, 1), (PlenopticCamera.preset("lfm"), 0)])
def test_cameras_begin_with_a_drawing_and_ten_lines_of_their_design_sheet(camera, pictures):
    first, _, rest = camera._repr_html_().partition("<details>")
    assert first.count("<img") == pictures and first.count("<tr>") == 10
    assert "focal length" in first and "pixel size" in rest


@pytest.fixture(scope="module")
def computed(raw, tmp_path_factory):
    folder = tmp_path_factory.mktemp("computed")
    distances = ["--distance", "236", "--distance", "244"]
    for command in (["stack", *distances], ["reconstruct", *distances], ["depth"], ["convert"], ["views"]):
        suffix = "nc" if command[0] == "convert" else "exr"
        assert main([command[0], str(raw), "-o", str(folder / f"{command[0]}.{suffix}"), *command[1:]]) == 0
    return folder


def test_the_command_shows_files_of_every_kind(raw, computed, tmp_path, run):
    path = tmp_path / "page.html"
    planes = [computed / name for name in ("reconstruct_244.exr", "reconstruct_236.exr")]
    assert "open it in a browser" in run("view", raw, *planes, computed / "depth.exr", "-o", path)
    found = content(path)
    assert [(plane["distance"], plane["method"]) for plane in found["planes"]] == [(236, "ray"), (244, "ray")]
    page = path.read_text()
    assert "<title>Letters, f/8, 128 x 128 microlenses</title>" in page and "ray model; 256 x 256 pixels" in page
    assert found["depth"]
    run("view", computed / "convert.nc", raw, "-o", path)
    assert [one["name"] for one in content(path)["recordings"]] == ["convert", "raw"]
    run("view", computed / "stack.exr", "-o", path)
    assert len(content(path)["planes"]) == 2 and not content(path)["recordings"]
    tifffile.imwrite(tmp_path / "raw.tiff", np.uint16(60000 * np.clip(read_capture(raw).image, 0, 1)))
    (tmp_path / "camera.json").write_text(read_capture(raw).camera.to_json())
    run("view", tmp_path / "raw.tiff", "--linear", "--camera", tmp_path / "camera.json")
    assert content(tmp_path / "raw.html")["recordings"][0]["raw"]["rows"] == 256


def test_what_view_refuses(raw, computed, tmp_path, complaint):
    stack, page = computed / "stack.exr", ["-o", tmp_path / "page.html"]
    assert "in .html" in complaint("view", raw, "-o", tmp_path / "page.png")
    assert complaint("view", raw, raw, raw, *page).startswith("sources: 3 captures")
    assert "it holds a 'views'" in complaint("view", computed / "views.exr", *page)
    assert "no such file" in complaint("view", tmp_path / "none.exr", *page)
    assert complaint("view", stack, "--white", raw, *page).startswith(f"--white {raw}: ")
    write_exr_parts(tmp_path / "a.exr", {"240 mm": {"Y": np.zeros((2, 2))}}, {"kind": "focal stack"})
    assert "the distance of each image" in complaint("view", tmp_path / "a.exr", *page)
    write_exr_parts(tmp_path / "a.exr", {"depth": {"Z": np.zeros((2, 2))}}, {"kind": "depth"})
    assert complaint("view", tmp_path / "a.exr", *page).endswith("a.exr: it has no part confidence")
    assert not (tmp_path / "page.html").exists()
