"""The command ``view``: what it takes, and what it refuses."""

import json

import numpy as np
import pytest
import tifffile
from foreign_files import write_exr_parts

from mitsuba_plenoptic import read_capture


@pytest.fixture(scope="module")
def computed(raw, tmp_path_factory):
    """Write a focal stack, reconstructions and a depth map of the capture once."""
    from mitsuba_plenoptic.cli import main

    folder = tmp_path_factory.mktemp("computed")
    distances = ["--distance", "236", "--distance", "244"]
    for command in (["stack", *distances], ["reconstruct", *distances], ["depth"], ["convert"], ["views"]):
        suffix = "nc" if command[0] == "convert" else "exr"
        assert main([command[0], str(raw), "-o", str(folder / f"{command[0]}.{suffix}"), *command[1:]]) == 0
    return folder


def data(path):
    return json.loads(path.read_text().split('<script type="application/json" id="data">')[1].split("</script>")[0])


def test_everything_of_a_capture(raw, computed, tmp_path, run):
    path = tmp_path / "page.html"
    planes = [computed / name for name in ("reconstruct_244.exr", "reconstruct_236.exr")]
    assert "open it in a browser" in run("view", raw, *planes, computed / "depth.exr", "-o", path)
    found = data(path)
    assert [plane["distance"] for plane in found["planes"]] == [236, 244]
    assert found["planes"][0]["method"] == "ray" and found["depth"] and found["recordings"][0]["raw"]
    page = path.read_text()
    assert "<title>Letters, f/8, 128 x 128 microlenses</title>" in page and "ray model; 256 x 256 pixels" in page


def test_light_fields_stacks_and_raw_pictures(raw, computed, tmp_path, run):
    path = tmp_path / "page.html"
    run("view", computed / "convert.nc", raw, "-o", path)
    assert [one["name"] for one in data(path)["recordings"]] == ["convert", "raw"]
    run("view", computed / "stack.exr", "-o", path)
    assert len(data(path)["planes"]) == 2 and not data(path)["recordings"]
    image = read_capture(raw).image
    tifffile.imwrite(tmp_path / "raw.tiff", np.uint16(60000 * np.clip(image, 0, 1)))
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps(read_capture(raw).camera.to_dict()))
    run("view", tmp_path / "raw.tiff", "--linear", "--camera", camera)
    assert data(tmp_path / "raw.html")["recordings"][0]["raw"]["rows"] == 256


def test_refused(raw, computed, tmp_path, complaint):
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
