"""Arrays and arguments of Python that break a rule, and odd ones that do not."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_plenoptic.capture.incoherent import incoherent_sum

from mitsuba_plenoptic import (
    Capture,
    Detector,
    InputError,
    PlenopticCamera,
    decode,
    design,
    expose,
    point_spread_function,
    reconstruct,
    render_capture,
)
from mitsuba_plenoptic.capture.scene import set_variant
from mitsuba_plenoptic.lightfield import (
    FourierRefocuser,
    LensGrid,
    depth_map,
    epipolar_image,
    estimate_lens_grid,
    focal_stack,
    pick_views,
    refocus,
    shift_and_add,
    view,
    white_image,
)
from mitsuba_plenoptic.lightfield.exchange import write_lftoolbox, write_mosaic

from . import cameras, corpus
from .cases import Case
from .values import NOT_FINITE, NOT_NUMBERS, NOT_POSITIVE, NOT_WHOLE, TOO_LARGE, pick

NOT_LENGTHS = (*NOT_NUMBERS, *NOT_FINITE, *NOT_POSITIVE, *TOO_LARGE, None)
NOT_COUNTS = (*NOT_NUMBERS, *NOT_FINITE, *NOT_POSITIVE, *NOT_WHOLE, None)
# One of a kind of array counts as numbers where several are taken.
NOT_DISTANCES = ("240", b"2", None, object(), 1j, True, {"a": 1}, *NOT_FINITE, *NOT_POSITIVE, *TOO_LARGE, [], [80.0],
                 [240.0, math.nan], [240.0, "x"], 79.9, [[240.0]])  # fmt: skip


def array_case(random: np.random.Generator, folder: Path) -> Case:
    """Make an image that is none, or holds what is not allowed."""
    what, image, forbidden = _image(random)
    camera = corpus.camera()
    name, run = pick(
        random,
        (
            ("Capture", lambda: Capture(image, camera)),
            ("reconstruct", lambda: reconstruct(image, 240.0, camera=camera)),
            ("coherent", lambda: reconstruct(image, 240.0, camera=camera, method="coherent", wavelength=633.0)),
            ("partial", lambda: reconstruct(image, [210, 240], camera=camera, method="partial", wavelength=633.0)),
            ("decode", lambda: decode(image, camera=camera)),
            ("white", lambda: decode(corpus.capture(), white=image)),
            ("expose", lambda: expose(Capture(image, camera), Detector(), photons=100)),
            ("estimate_lens_grid", lambda: _grid_of(image)),
        ),
    )
    if name == "white" and image is None:
        # The default: it is computed.
        forbidden = False
    return Case(f"{name} of {what}", run, forbidden)


def _grid_of(image: Any) -> Any:
    grid = estimate_lens_grid(image)
    return [np.array(grid.spacing), np.array(grid.offset)]


def _image(random: np.random.Generator) -> tuple[str, Any, bool]:
    image = corpus.capture().image.copy()
    place = int(random.integers(64)), int(random.integers(64))
    way = random.random()
    if way < 0.4:
        value = pick(random, (math.nan, math.inf, -math.inf, 1e31, -1e31, 3e38))
        image[place] = value
        return f"an image with {value}", image, True
    if way < 0.6:
        bad: tuple[Any, ...] = (
            image[:5], image[None], image[..., None, None], np.zeros((64, 64, 2)), np.zeros((64, 64, 0)), np.zeros(0),
            image.astype(complex), image.astype(bool), image.astype(str), image.astype(object), "image", None, 3, {},
            [[1, 2], [3]], np.zeros((64, 64), "M8[s]"), np.zeros((64, 64), [("a", "f4")]), np.zeros((64, 63)),
            np.full((64, 64), 1e300), [["a"] * 64] * 64,
        )  # fmt: skip
        value = pick(random, bad)
        return f"{type(value).__name__} {np.shape(value) if isinstance(value, np.ndarray) else ''}", value, True
    kind = pick(random, ("u1", "i2", "u8", ">f4", "f2", "f8", "black", "huge", "tiny", "view", "one", "negative"))
    odd: dict[str, Any] = {
        "black": np.zeros_like(image),
        "huge": image * np.float32(9e29 / image.max()),
        "tiny": image * np.float32(1e-38),
        "view": np.asfortranarray(image)[::-1, ::-1],
        "one": np.where(np.arange(64 * 64).reshape(64, 64) == 100, 1, 0),
        "negative": -image,
    }
    return f"{kind} image", odd[kind] if kind in odd else (image * 100).astype(kind), False


def argument_case(random: np.random.Generator, folder: Path) -> Case:
    """Make one argument of a function that the documentation forbids."""
    what, run = pick(random, (_reconstruct, _wave, _decode, _detector, _spread, _sum, _light_field, _write, _grid))(
        random, folder
    )
    return Case(what, run, forbidden=True)


def _takes_long(camera: PlenopticCamera) -> bool:
    """Tell whether the white image of a camera honestly takes seconds: wide micro-images, far out of focus."""
    b, z = camera.mla_distance, camera.detector_distance
    smear = camera.mla_pitch * abs(1 + b / z - b / camera.mla_focal_length) * z / b / camera.pixel_size
    work = max(camera.micro_image_diameter / camera.pixel_size + smear, 1) * max(smear, 1)
    # Beyond the upper bound it is refused.
    return 1e7 < camera.lens_count[0] * camera.lens_count[1] * work**2 < 1e12


def extreme_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a camera of allowed numbers, however odd, with everything that takes one."""
    camera = cameras.extreme_camera(random)
    while _takes_long(camera):
        camera = cameras.extreme_camera(random)
    image = np.random.default_rng(0).random(camera.shape, dtype=np.float32)
    f1 = camera.focal_length
    distance = float(np.clip(f1 * (1 + np.exp(random.normal(0, 3))), np.nextafter(f1, 2e9), 1e9))
    wavelength = float(np.exp(random.uniform(0, math.log(1e6))))
    what, run = pick(
        random,
        (
            ("white_image", lambda: white_image(camera)),
            ("ray capture", lambda: render_capture(wall(camera, distance), spp=1)),
            (
                "wave capture",
                lambda: render_capture(wall(camera, distance), model="wave", spp=1, radiators_per_lens=1),
            ),
            ("decode", lambda: decode(image, camera=camera)),
            ("stack", lambda: focal_stack(decode(image, camera=camera), [distance])),
            ("depth", lambda: depth_map(decode(image, camera=camera), planes=3)),
            ("rays", lambda: reconstruct(image, distance, camera=camera, oversample=int(random.integers(1, 5)))),
            ("point", lambda: reconstruct(image, distance, camera=camera, footprint="point")),
            ("coherent", lambda: reconstruct(image, distance, camera=camera, method="coherent", wavelength=wavelength)),
            (
                "auto",
                lambda: reconstruct(
                    image, distance, camera=camera, method="partial", interleave="auto", wavelength=wavelength
                ),
            ),
            ("patch", lambda: point_spread_function(camera, (0.0, 0.0, distance), wavelength=wavelength)),
            (
                "full_field",
                lambda: point_spread_function(camera, (0.0, 0.0, distance), wavelength=wavelength, method="full_field"),
            ),
        ),
    )
    return Case(f"{what} of {camera.to_dict()}", run)


def wall(camera: PlenopticCamera, distance: float) -> Any:
    """Make a scene with a small shining square before the camera."""
    set_variant("llvm_ad_mono")
    numbers = camera.to_dict()
    (columns, rows), (left, top), (width, height) = (numbers.pop(name) for name in cameras.PAIRS)
    # A plugin takes several numbers as text.
    numbers |= {name: ", ".join(map(repr, value)) for name, value in numbers.items() if isinstance(value, tuple)}
    size = min(design.field_width(camera, distance) / 8, 1e6)
    film = {"type": "hdrfilm", "width": columns, "height": rows, "rfilter": {"type": "box"},
            "pixel_format": "luminance", "component_format": "float32", "crop_offset_x": left, "crop_offset_y": top,
            "crop_width": width, "crop_height": height}  # fmt: skip
    place = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([0, 1, 0], 180).scale(size)
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {"type": "plenoptic", **numbers, "film": film},
        "wall": {"type": "rectangle", "to_world": place, "light": {"type": "area", "radiance": 1.0}},
    }
    try:
        return mi.load_dict(scene)
    except RuntimeError as error:
        # Mitsuba passes on what a plugin's constructor raises as a text.
        told = str(error).strip().splitlines()[-1]
        if "InputError: " not in told:
            raise
        raise InputError(told.split("InputError: ", 1)[1]) from None


def _reconstruct(random: np.random.Generator, folder: Path) -> tuple[str, Any]:
    capture = corpus.capture()
    bad = pick(
        random,
        (
            {"distance": pick(random, NOT_DISTANCES)},
            {"method": pick(random, ("magic", None, 1, [], "RAY"))},
            {"footprint": pick(random, ("magic", None, 1, []))},
            {"oversample": pick(random, (*NOT_COUNTS, 100_000, 10**9))},
            {"interleave": pick(random, (*NOT_COUNTS, 10**9, "AUTO", "2"))},
            {
                "camera": pick(
                    random, ("camera", 1, {}, corpus.camera().replace(resolution=(32, 32), crop_size=(32, 32)))
                )
            },
        ),
    )
    arguments = {"distance": 240.0, **bad}
    return f"reconstruct {ascii(bad)[:100]}", lambda: reconstruct(capture, arguments.pop("distance"), **arguments)


def _wave(random: np.random.Generator, folder: Path) -> tuple[str, Any]:
    plain, camera = corpus.capture().image, corpus.camera()
    wavelengths = ("633", None, [], [633.0, 500.0], True, {}, *NOT_FINITE, *NOT_POSITIVE, 1e-3, 1e7, 0.5, 2e6)
    if random.random() < 0.2:
        image = plain.copy()
        image[5, 6] = -1e-3
        return "negative pixel", lambda: reconstruct(image, 240, camera=camera, method="coherent", wavelength=633)
    value = pick(random, wavelengths)
    method = pick(random, ("coherent", "partial"))
    return (
        f"{method} wavelength {ascii(value)[:60]}",
        lambda: reconstruct(plain, 240.0, camera=camera, method=method, wavelength=value),
    )


def _decode(random: np.random.Generator, folder: Path) -> tuple[str, Any]:
    image, camera = corpus.capture().image, corpus.camera()
    return pick(
        random,
        (
            ("no camera", lambda: decode(image)),
            ("another camera", lambda: decode(image, camera=camera.replace(resolution=(32, 32), crop_size=(32, 32)))),
            ("white of another size", lambda: decode(image, camera=camera, white=image[:5])),
            ("camera of another type", lambda: decode(image, camera=pick(random, ("x", 3, {})))),
            ("grid of another type", lambda: decode(image, camera=camera, grid=pick(random, ("x", 3, {})))),
            ("a black white without camera", lambda: decode(image, white=image * 0, grid=_lattice())),
            ("no white", lambda: decode(image, grid=_lattice())),
            ("a fine lattice", lambda: decode(image, white=image, grid=LensGrid((1e-3, 1e-3), (0, 0), (10**6, 10**6)))),
        ),
    )


def _lattice() -> LensGrid:
    return LensGrid((16.0, 16.0), (8.0, 8.0), (4, 4))


def _detector(random: np.random.Generator, folder: Path) -> tuple[str, Any]:
    not_positive = (*NOT_NUMBERS, *NOT_FINITE, *NOT_POSITIVE, *TOO_LARGE, 1e-10)
    not_negative = (*NOT_NUMBERS, *NOT_FINITE, -1, -1e-9, *TOO_LARGE, None)
    bad = pick(
        random,
        (
            {"quantum_efficiency": pick(random, (*not_positive, 1.0001, None))},
            {"full_well": pick(random, (*not_positive, 0.5, None))},
            {"dark_electrons": pick(random, not_negative)},
            {"read_noise": pick(random, not_negative)},
            {"bits": pick(random, (*NOT_COUNTS, 17, 1000))},
            {"gain": pick(random, not_positive)},
            {"black_level": pick(random, (*NOT_NUMBERS, *NOT_FINITE, *NOT_WHOLE, -1, 4095, 10**9))},
        ),
    )
    if random.random() < 0.3:
        photons = pick(random, (*not_positive, None))
        return f"photons {ascii(photons)[:60]}", lambda: expose(corpus.capture(), Detector(), photons=photons)
    if random.random() < 0.3:
        seed = pick(random, (*NOT_NUMBERS, *NOT_FINITE, *NOT_WHOLE, -1, None))
        return f"seed {ascii(seed)[:60]}", lambda: expose(corpus.capture(), Detector(), photons=10, seed=seed)
    return f"Detector {ascii(bad)[:80]}", lambda: Detector(**bad)


def _spread(random: np.random.Generator, folder: Path) -> tuple[str, Any]:
    camera = corpus.camera()
    positions = (None, 240.0, (0, 0), (0, 0, 0, 240), (0, 0, -240), (0, 0, 0), (math.nan, 0, 240), (0, math.inf, 240),
                 ("a", 0, 240), "abc", [], (1e9, 0, 1e-3), (0, 0, 10**400), (0, 0, 1e300), {1, 2, 3},
                 (0, 0, 1e-300))  # fmt: skip
    position, wavelength, method = (0.0, 0.0, 240.0), 633.0, pick(random, ("patch", "full_field"))
    way = random.random()
    if way < 0.5:
        position = pick(random, positions)
    elif way < 0.9:
        wavelength = pick(random, (*NOT_LENGTHS, 0.1, 1e7))
    else:
        method = pick(random, ("magic", None, 3, []))
    told = f"point spread at {ascii(position)[:50]}, {ascii(wavelength)[:50]} nm, {method}"
    return told, lambda: point_spread_function(camera, position, wavelength=wavelength, method=method)


def _sum(random: np.random.Generator, folder: Path) -> tuple[str, Any]:
    positions: Any = np.array([[0.0, 0.0, 240.0], [0.1, 0.0, 240.0]])
    arguments: dict[str, Any] = {"weights": [1.0, 1.0], "wavelength": 633.0}
    arguments.update(
        pick(
            random,
            (
                {
                    "weights": pick(
                        random, ([1.0], [1.0, math.nan], [1.0, -1.0], [math.inf, 1], "ab", None, [[[1]], [[1]]])
                    )
                },
                {"accuracy": pick(random, (-0.1, 1.0, 2, "x", None, math.nan, True, [0.1, 0.2]))},
                {
                    "pupil_masks": pick(
                        random, ("x", 1, np.ones((2, 4, 4)), np.ones((1, 4, 4), bool), np.ones((2, 4, 3), bool))
                    )
                },
                {"wavelength": pick(random, NOT_LENGTHS)},
                {"method": pick(random, ("magic", None, []))},
            ),
        )
    )
    weights = arguments.pop("weights")
    return f"sum {ascii(arguments)[:90]}", lambda: incoherent_sum(corpus.camera(), positions, weights, **arguments)


def _light_field(random: np.random.Generator, folder: Path) -> tuple[str, Any]:
    whole = corpus.light_field()
    lf = whole
    way = random.random()
    told = "light field"
    if way < 0.4:
        told, lf = pick(
            random,
            (
                ("an array", whole.values),
                ("None", None),
                ("transposed", whole.transpose("s", "t", "u", "v")),
                ("without weight", whole.drop_vars("weight")),
                ("a view", whole[0]),
                ("NaN", whole.where(whole != whole.max())),
                ("infinity", whole + np.where(whole.values == float(whole.max()), np.inf, 0)),
            ),
        )
        functions = (
            lambda: refocus(lf, 240.0),
            lambda: depth_map(lf, 200, 300, planes=3),
            lambda: shift_and_add(lf, 0.0),
            lambda: view(lf),
            lambda: pick_views(lf, 1),
            lambda: epipolar_image(lf),
            lambda: FourierRefocuser(lf, 0.1),
            lambda: write_mosaic(folder / "x.png", lf),
            lambda: write_lftoolbox(folder / "x.mat", lf),
        )
        return f"light field: {told}", pick(random, functions)
    distance = pick(random, [value for value in NOT_DISTANCES if not (np.ndim(value) == 0 and value == np.inf)])
    number = pick(random, (*NOT_NUMBERS, *NOT_FINITE, None))
    planes = pick(random, (*NOT_COUNTS, 1, 2, 10**6))
    count = pick(random, (*NOT_COUNTS, 1000))
    return pick(
        random,
        (
            (f"refocus to {ascii(distance)[:60]}", lambda: refocus(lf, distance)),
            ("focal_stack of none", lambda: focal_stack(lf, [])),
            ("focal_stack method", lambda: focal_stack(lf, [240.0], method=pick(random, ("magic", None)))),
            (f"shift_and_add {ascii(number)[:60]}", lambda: shift_and_add(lf, number)),
            (f"depth planes {ascii(planes)[:60]}", lambda: depth_map(lf, planes=planes)),
            ("depth near beyond far", lambda: depth_map(lf, 300, 200)),
            (
                f"depth near {ascii(number)[:60]}",
                lambda: depth_map(lf, near="x" if number is None else number, far=300),
            ),
            (f"view {ascii(number)[:60]}", lambda: view(lf, u=number)),
            (f"views {ascii(count)[:60]}", lambda: pick_views(lf, count)),
            ("epi axis", lambda: epipolar_image(lf, pick(random, ("diagonal", None)))),
            (f"epi at {ascii(number)[:60]}", lambda: epipolar_image(lf, at=number)),
            (f"fourier {ascii(number)[:60]}", lambda: FourierRefocuser(lf, number)),
        ),
    )


def _write(random: np.random.Generator, folder: Path) -> tuple[str, Any]:
    from mitsuba_plenoptic import read_capture, write_capture

    (folder / "folder.exr").mkdir()
    bad: tuple[Any, ...] = ("", "\0", "a\0b.exr", None, 3, b"x.exr", "nowhere/raw.exr", ".", "folder.exr", "x" * 5000,
                            "/dev/null", "/dev/full", "/proc/version", "raw.exr/raw.exr")  # fmt: skip
    name = pick(random, bad)
    path = folder / name if isinstance(name, str) and name and not name.startswith("/") else name
    if random.random() < 0.5:
        return f"read {ascii(name)[:60]}", lambda: read_capture(path)
    return f"write {ascii(name)[:60]}", lambda: write_capture(path, corpus.capture())


def _grid(random: np.random.Generator, folder: Path) -> tuple[str, Any]:
    values: dict[str, Any] = {"spacing": (16.0, 16.0), "offset": (8.0, 8.0), "shape": (4, 4)}
    name = pick(random, ("spacing", "offset", "shape", "rotation", "shifted_rows"))
    one = {
        "spacing": (*NOT_LENGTHS, 0.0),
        "offset": (*NOT_NUMBERS, *NOT_FINITE, None),
        "shape": NOT_COUNTS,
        "rotation": (*NOT_NUMBERS, *NOT_FINITE, None),
        "shifted_rows": (2, -1, "x", 0.5, math.nan, [0]),
    }[name]
    value = pick(random, one)
    if name in ("spacing", "offset", "shape"):
        value = pick(random, ((value, 4), (4, value), (4,), 4, None, (4, 4, 4), "ab"))
    values[name] = value
    return f"LensGrid {name} = {ascii(value)[:60]}", lambda: LensGrid(**values)
