"""Apertures of blades and pictures: rays against pupil points masked here, waves against NumPy."""

import json
import math
import pickle

import mitsuba as mi
import numpy as np
import pytest
from cases import APERTURES as PUPILS
from cases import WIDE, diffracted, facing, ordinary_camera, radiating, scene_of, textured_wall
from scipy.signal import fftconvolve

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Aperture, PlenopticCamera, render_capture, views
from mitsuba_plenoptic.report.design_sheet import design_sheet
from tools.bench.cases import ordinary_cameras

THIN = {"focal_length": 50.0, "focus_distance": 300.0, "aperture_radius": 8.0, "detector_width": 12.0}
FILM = {"resolution": (24, 16)}
WAVELENGTH = 550.0
WHITE = {"sky": {"type": "constant"}}

# Open cells in rows of rising y and columns of rising x, with nothing that turning or mirroring would leave alike.
CODE = np.pad(np.array([[1, 1, 0, 1, 0], [0, 1, 1, 0, 1], [1, 0, 0, 1, 1], [0.5, 1, 0, 0, 1], [1, 0, 1, 0.2, 0]]), 1)
APERTURES = {
    "hexagon": {"aperture_blades": (6, 15.0)},
    "square": {"aperture_blades": 4},
    "coded": {"aperture_image": CODE},
}


def ordinary(**given):
    return PlenopticCamera(mla_lattice="none", **(THIN | FILM | given))


def plenoptic(**given):
    return PlenopticCamera(detector_width=1.024, resolution=(128, 128), **given)


def polygon(count, angle):
    """Which points are within all sides of a polygon, by their distances from the centre."""
    normals = math.radians(angle) + (np.arange(count) + 0.5) * 2 * math.pi / count
    return lambda x, y: np.all(
        [x * math.cos(n) + y * math.sin(n) <= math.cos(math.pi / count) for n in normals], axis=0
    ).astype(float)


def code(x, y):
    """Values of the coded aperture by nearest rows and columns."""
    column, row = (np.clip(((place + 1) / 2 * len(CODE)).astype(int), 0, len(CODE) - 1) for place in (x, y))
    return CODE[row, column] * (np.hypot(x, y) <= 1)


MASKS = {"hexagon": polygon(6, 15.0), "square": polygon(4, 0.0), "coded": code}


def open_part(name):
    """Mean of a mask over the circle."""
    mask, along = masked(name, 1008)
    return mask.sum() / np.count_nonzero(np.hypot(along, along[:, None]) <= 1)


def masked(name, count):
    """A mask on a grid of samples of the square around the pupil, and their coordinates over its radius."""
    along = (np.arange(count) + 0.5) * 2 / count - 1
    return MASKS[name](along[None, :] + 0 * along[:, None], along[:, None] + 0 * along), along


def difference(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


# -- parameters --------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", APERTURES.values(), ids=APERTURES)
def test_files_and_sensors_keep_apertures(given):
    camera = ordinary(**given)
    scene = mi.load_string(f"<scene version='3.0.0'>{camera.to_xml()}</scene>")
    copies = [
        PlenopticCamera.from_json(camera.to_json()),
        pickle.loads(pickle.dumps(camera)),
        mi.load_dict(camera.to_sensor()).camera,
        scene.sensors()[0].camera,
        camera.replace(aperture_radius=1.0).replace(aperture_radius=8.0),
    ]
    assert all(copy == camera and hash(copy) == hash(camera) for copy in copies)
    assert camera != ordinary() and "0.0, 1.0, 1.0" not in repr(camera)


def test_pictures_are_read_from_files(tmp_path):
    values = np.round(CODE * 255) / 255
    mi.Bitmap(np.round(CODE * 255).astype(np.uint8)[..., None]).write(str(tmp_path / "code.png"))
    mi.Bitmap(values.astype(np.float32)[..., None]).write(str(tmp_path / "code.exr"))
    np.save(tmp_path / "code.npy", values)
    (tmp_path / "code.json").write_text(json.dumps({"transmission": values.tolist()}))
    for file in tmp_path.iterdir():
        assert ordinary(aperture_image=file).aperture_image == Aperture(values)
        assert ordinary(aperture_image={"transmission": str(tmp_path / "code.npy")}).aperture_image == Aperture(values)


# -- rays --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", APERTURES)
def test_a_white_scene_reads_the_open_part_of_the_circle(name):
    part = open_part(name)
    image = render_capture(scene_of(ordinary(**APERTURES[name]).to_sensor(), **WHITE), spp=16).image
    assert image.mean() == pytest.approx(part, rel=0.002) and image.std() < 0.01 * part
    # Behind microlenses the sum over all pixels has this part.
    round_ = render_capture(scene_of(plenoptic().to_sensor(), **WHITE), spp=64).image
    other = render_capture(scene_of(plenoptic(**APERTURES[name]).to_sensor(), **WHITE), spp=64).image
    assert other.sum() / round_.sum() == pytest.approx(part, rel=0.01)


def by_hand(camera, distance, half, centre, name, count=420):
    """The picture of a square lamp, the sum over points of the masked pupil: lines of its light on each axis."""
    mask, along = masked(name, count)
    P, b = along * camera.aperture_radius, camera.mla_distance
    lines = []
    for axis, middle in ((0, centre), (1, 0.0)):
        # Where rays through P from the edges of the lamp land, and the parts of pixels between them.
        low, high = (P + b * (P - middle - side * half) / distance - b * P / camera.focal_length for side in (1, -1))
        x, step = camera.pixel_coordinates(axis)[:, None], camera.pixel_size
        lines.append((np.minimum(high, x + step / 2) - np.maximum(low, x - step / 2)).clip(0) / step)
    return lines[1] @ mask @ lines[0].T / np.count_nonzero(np.hypot(along, along[:, None]) <= 1)


@pytest.mark.parametrize("distance", [200.0, 600.0], ids=["near", "far"])
def test_the_bokeh_of_a_lamp_is_the_picture_in_the_pupil(distance):
    """Light of a near lamp lands on the side of the axis where it passes the pupil; that of a far one has crossed it.

    Columns of a capture rise with x of the camera frame on the detector, and rows with y.
    """
    camera = ordinary(aperture_image=CODE, detector_width=4.0, resolution=(60, 40))
    lamp = {"lamp": facing(distance, distance / 200, (distance / 120, 0.0), **radiating())}
    image = render_capture(scene_of(camera.to_sensor(), **lamp), spp=2048).image
    expected = by_hand(camera, distance, distance / 200, distance / 120, "coded")
    assert difference(image, expected) < 0.07
    assert image.sum() == pytest.approx(expected.sum(), rel=0.01)
    for other in (CODE[::-1], CODE[:, ::-1], CODE.T, CODE[::-1, ::-1]):
        wrong = render_capture(scene_of(camera.replace(aperture_image=other).to_sensor(), **lamp), spp=64).image
        assert difference(wrong, expected) > 0.3
    # Only the cell at +x is open.
    side = np.zeros((5, 5))
    side[2, 4] = 1
    lit = render_capture(scene_of(camera.replace(aperture_image=side).to_sensor(), **lamp), spp=64).image
    middle = -camera.mla_distance * (distance / 120) / distance
    moved = (lit.sum(0) @ camera.pixel_coordinates(0)) / lit.sum() - middle
    assert moved == pytest.approx(0.8 * camera.aperture_radius * camera.defocus(distance), rel=0.05)


# -- plenoptic cameras -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", APERTURES)
def test_white_micro_images_are_decoded_and_refocused_to_one(name):
    camera = plenoptic(**APERTURES[name])
    capture = render_capture(scene_of(camera.to_sensor(), **WHITE), spp=256)
    computed = views.white_image(camera)
    assert difference(capture.image, computed) < 0.06
    assert capture.image.mean() == pytest.approx(computed.mean(), rel=0.003)
    field = mp.decode(capture)
    seen = field.values[:, :, 2:-2, 2:-2][field.coords["weight"].values[:, :, 2:-2, 2:-2] > 0]
    assert seen.mean() == pytest.approx(1, abs=0.01) and seen.std() < 0.06
    refocused = mp.reconstruct(capture, 220.0, method="ray").image[2:-2, 2:-2]
    assert refocused == pytest.approx(1, abs=0.05)


def test_the_picture_in_micro_images_is_the_right_way_round():
    camera = plenoptic(aperture_image=CODE)
    image = render_capture(scene_of(camera.to_sensor(), **WHITE), spp=64).image
    for other in (CODE[::-1], CODE[:, ::-1], CODE.T, CODE[::-1, ::-1]):
        assert difference(image, views.white_image(camera.replace(aperture_image=other))) > 0.3


LAMP = (0.05, 0.02, 230.0)


@pytest.mark.parametrize("method", [pytest.param("full_field", marks=pytest.mark.slow), "patch"])
def test_waves_of_points_pass_the_picture(method):
    """As with its cells as the point's pupil weights, and where rays of a small lamp arrive."""
    camera = plenoptic(aperture_image=CODE).replace(detector_width=0.256, resolution=(64, 64))
    found = mp.CaptureOperator(camera, [LAMP], wavelength=WAVELENGTH, method=method).forward([1.0])
    round_ = camera.replace(aperture_image=None)
    weights = {"pupil_weights": CODE[None], "wavelength": WAVELENGTH, "method": method}
    assert difference(found, mp.CaptureOperator(round_, [LAMP], **weights).forward([1.0])) < 1e-4
    if method == "patch":
        return

    def by_rays(picture):
        lamp = facing(LAMP[2], 0.02, LAMP[:2], **radiating())
        sensor = camera.replace(aperture_image=picture).to_sensor()
        image = render_capture(scene_of(sensor, "direct", lamp=lamp), spp=512).image
        return np.corrcoef(image.ravel(), found.ravel())[0, 1]

    assert by_rays(CODE) > 0.87
    assert all(by_rays(other) < 0.8 for other in (CODE[::-1], CODE[:, ::-1], CODE.T, CODE[::-1, ::-1]))


def test_design_sheets_tell_the_open_part():
    rows = [row for row in design_sheet(ordinary(aperture_blades=6)) if row.quantity.startswith("open part")]
    assert [row.value for row in rows] == ["0.827"]


# -- waves -------------------------------------------------------------------------------------------


def diffracting(name, size, airy=1.0):
    """An f/20 camera with pixels of `airy` radii of a round pupil's Airy disc, and lambda b / R in millimetres."""
    unit = WAVELENGTH * 1e-6 * 120 / 2
    width = size * airy * 0.60983 * unit
    thin = {"focal_length": 80.0, "aperture_radius": 2.0, "mla_distance": 120.0, "resolution": (size, size)}
    return PlenopticCamera(mla_lattice="none", detector_width=width, **thin, **APERTURES[name]), unit


def wavefield(name, unit, along, blur, samples=1008):
    """|Fourier transform|^2 of the mask, of unit sum over the whole detector, with a blur of so many units."""
    mask, pupil = masked(name, samples)
    square = pupil**2 + pupil[:, None] ** 2
    field = np.sqrt(mask) * np.exp(-1j * np.pi * blur * square)
    waves = np.exp(-2j * np.pi * np.outer(along / unit, pupil))
    step = (along[1] - along[0]) / unit
    return np.abs(waves @ field @ waves.T) ** 2 * step**2 * (2 / samples) ** 4 / (mask.mean() * 4)


def expected_of(name, camera, unit, picture, fine, blur):
    """The capture of a picture, (n, n) on a grid `fine` times as fine as pixels and centred, by a convolution."""
    step, size = camera.pixel_size / fine, camera.resolution[0]
    reach = (len(picture) - size * fine) // 2
    spread = wavefield(name, unit, np.arange(-reach, reach + 1) * step, blur)
    # What is beyond has no structure.
    spread += (1 - spread.sum()) / spread.size
    whole = fftconvolve(picture, spread, mode="same")[reach : reach + size * fine, reach : reach + size * fine]
    return whole.reshape(size, fine, size, fine).mean((1, 3)) * open_part(name)


def by_waves(scene, spp):
    return render_capture(scene, model="wave", spp=spp, wavelength=WAVELENGTH).image


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "coded")) for name in APERTURES]
)
def test_a_star_in_focus_is_the_transform_of_the_mask(name):
    camera, unit = diffracting(name, 12)
    size, fine, distance = 12, 8, camera.focus_distance
    half = camera.pixel_size * distance / 120
    lamp = facing(distance, half, (-half / 2, 0.0), **radiating())
    found = by_waves(scene_of(camera.to_sensor(), "direct", lamp=lamp), 4096)
    count = 9 * size * fine
    at = (np.arange(count) + 0.5 - count / 2) / fine
    picture = np.outer(np.abs(at) < 1, np.abs(at - 0.5) < 1) * 1.0
    expected = expected_of(name, camera, unit, picture, fine, 0.0)
    # Rays through closed cells have noise of their own.
    assert difference(found, expected) < (0.015 if name == "coded" else 0.01)
    place = camera.pixel_coordinates(0)
    radius = np.hypot(place - 0.5 * camera.pixel_size, place[:, None]) / camera.pixel_size
    for circle in (1.5, 3, 5):
        part = (found - expected)[radius < circle].sum()
        assert abs(part) < 0.005 * expected.sum(), circle


WALLS = [
    pytest.param("hexagon", 1.0, 0.01, marks=pytest.mark.slow),
    pytest.param("square", -3.0, 0.01, marks=pytest.mark.slow),
    pytest.param("coded", 0.0, 0.01, marks=pytest.mark.slow),
    pytest.param("coded", 1.0, 0.01, marks=pytest.mark.slow),
    # Blur and diffraction of single cells are alike.
    ("coded", -6.0, 0.01),
]


@pytest.mark.parametrize(("name", "blur", "limit"), WALLS)
def test_walls_are_sums_over_the_mask(name, blur, limit):
    camera, unit = diffracting(name, 16)
    size, fine, texel = 16, 4, 2
    distance = 1 / (1 / 80 - (1 + blur * unit / 2) / 120)
    count = 2 * math.ceil((size + 2 * (40 + abs(blur)) * unit / camera.pixel_size) / (2 * texel))
    values = np.random.default_rng(3).random((count, count))
    data = mi.Bitmap(np.ascontiguousarray(values[::-1, :, None], np.float32))
    radiance = {"type": "bitmap", "bitmap": data, "filter_type": "nearest", "raw": True}
    half = count * texel * camera.pixel_size / 2 * distance / 120
    wall = facing(distance, half, emitter={"type": "area", "radiance": radiance})
    scene = scene_of(camera.to_sensor(), "direct", wall=wall)
    found = by_waves(scene, 4096)
    expected = expected_of(name, camera, unit, np.kron(values, np.ones((texel * fine,) * 2)), fine, blur)
    assert difference(found, expected) < limit
    assert found.sum() == pytest.approx(expected.sum(), rel=0.003)
    assert difference(render_capture(scene, spp=1024).image, expected) > 1.5 * limit


def test_light_of_two_holes_interferes_out_of_focus():
    """Rays through the closed middle bring the fringes, without which the wall differs by more than a fifth."""
    parameters, mask = PUPILS["two holes"]
    camera = ordinary_camera(1.0, 16, **parameters)
    scene, picture = textured_wall(camera, 4, 4.0, WIDE)
    expected = diffracted(camera, picture, 4, 4.0, mask=mask)
    assert difference(by_waves(scene, 256), expected) < 0.015
    assert difference(render_capture(scene, spp=256).image, expected) > 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", PUPILS)
def test_walls_through_apertures_of_any_shape(name):
    rows = list(ordinary_cameras.apertures(apertures=(name,), blurs=(0.0, 1.0, 4.0, 8.0), film=24))
    # Light behind few cells comes from far pixels, of which one in four is traced.
    limit = 0.013 if name == "33 x 33 with 33 open" else 0.01
    assert [row for row in rows if row["waves"] >= limit or row["rays"] < 2 * row["waves"]] == []


@pytest.mark.parametrize("name", ["hexagon", "coded"])
def test_a_white_scene_by_waves_reads_the_open_part(name):
    camera, _ = diffracting(name, 12)
    part = open_part(name)
    found = by_waves(scene_of(camera.to_sensor(), **WHITE), 16)
    # Of far pixels, from which single cells bring light, one in four is traced.
    assert found.mean() == pytest.approx(part, rel=0.003) and found.std() < 0.002
