"""What Python functions say of a wrong argument: one line with its name, not an error from within."""

import dataclasses
import inspect
import signal
import warnings

import mitsuba as mi
import numpy as np
import pytest
from cameras import letters
from refusals import refused, refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Capture, InputError, PlenopticCamera
from mitsuba_plenoptic.refocus import Volume, write_reconstruction, write_volume
from mitsuba_plenoptic.views.light_field_files import save_light_field
from mitsuba_plenoptic.views.mosaics import write_mosaic

CAMERA = PlenopticCamera(resolution=(64, 64), detector_width=0.128)
DECONVOLUTION = pytest.mark.needs_extension("deconvolution")
IMAGE = np.ones((64, 64), np.float32)


def scene():
    return mp.load_scene("letters", parameters=letters(2))


def captured(**options):
    return mp.render_capture(scene(), **options)


def refocused(**options):
    return mp.reconstruct(IMAGE, **({"distance": 240, "camera": CAMERA, "wavelength": 633} | options))


def operator(points=((0, 0, 240),), **options):
    return mp.CaptureOperator(CAMERA, points, **({"wavelength": 633} | options))


def by_another_variant():
    mi.set_variant("llvm_ad_rgb")
    sensor = mi.load_dict(CAMERA.to_sensor())
    mi.set_variant("llvm_ad_mono")
    return captured(sensor=sensor)


MISSPELT = CAMERA.to_sensor() | {"focal_lenght": 80.0}
OTHER = Capture(IMAGE, CAMERA.replace(mla_pitch=0.05))
NOISY = mp.expose(Capture(IMAGE, CAMERA), mp.Detector(), photons=100)

test_mistakes = refused(
    (lambda: dataclasses.replace(CAMERA, aperture_radius=3), r"dataclasses\.replace does not .*; use camera\.rep"),
    (lambda: refocused(distance=[[210, 220], [230]]), "distance = .*: it must be a number or several"),
    (lambda: refocused(method="coherent", relay="no"), "relay = 'no'"),
    (lambda: mp.load_scene("letters", parameters=["resolution"]), r"parameters = \['resolution'\]"),
    (lambda: mp.with_camera(5, CAMERA), "scene of type int"),
    (lambda: mp.with_camera(CAMERA, scene()), "camera of type Scene, scene = .*: they are swapped; scene comes first"),
    (lambda: mp.design.refocus_range(633, CAMERA), "wavelength of type Plenop.*, camera = 633: they are swapped"),
    (lambda: mp.reconstruct([240], Capture(IMAGE, CAMERA)), r"capture = \[240\]: .* swapped; capture comes first"),
    (lambda: PlenopticCamera(detector_width="5.5 mm"), "'5.5 mm': .* without a unit: lengths are in mm, "),
    (by_another_variant, "sensor of .* of variant llvm_ad_rgb: it must be .* active variant llvm_ad_mono"),
    (lambda: captured(model="wave", wavelength=[633, 500]), "wavelength: a value of type list"),
    (lambda: mp.LensSystem.of(CAMERA), "main_lens: the camera has none with surfaces"),
    (lambda: mp.expose(NOISY, mp.Detector(), photons=100), "capture: a detector has recorded it already"),
    (lambda: mp.decode(Capture(IMAGE, CAMERA), white=OTHER), r"white: .* mla_pitch = 0\.05, that of the capture 0\.06"),
    *(
        pytest.param(lambda o=options: refocused(method="deconvolved", **o), words, marks=DECONVOLUTION)
        for options, words in (
            ({"volume": "no"}, "volume = 'no'"),
            ({"response": "ray"}, "^wavelength: a response by rays has none"),
        )
    ),
)


@pytest.mark.parametrize(("call", "error", "words"), [
    (lambda: PlenopticCamera(focal_lenght=80), TypeError, "'focal_lenght'; did you mean focal_length?"),
    (lambda: PlenopticCamera(fnumber=2.8), TypeError, r"aperture_radius is focal_l.*; .* take f_number"),
    (lambda: PlenopticCamera.load, AttributeError, "'load'; from_json is of the text of a camera's file"),
    (lambda: mp.depth_map, AttributeError, r"did you mean views\.depth_map?"),
    (lambda: CAMERA.replace(mla_pich=0.05), InputError, "mla_pich: .*; did you mean mla_pitch?"),
    (lambda: PlenopticCamera.preset("litro"), InputError, "preset = 'litro': .*; did you mean lytro?"),
    (lambda: mp.Detector(red_noise=2), TypeError, "Detector() .*'red_noise'; did you mean read_noise?"),
    (lambda: refocused(method="magic"), InputError, "method = 'magic': it must be one of [^;]*$"),
    (lambda: mp.load_scene("leters"), InputError, "did you mean letters?"),
    (lambda: mp.load_scene("letters", parameters={"resolutoin": "64"}), InputError, "did you mean resolution?"),
    (lambda: mp.reconstrct, AttributeError, "did you mean reconstruct?"),
    (lambda: captured(modl="wave"), TypeError, "'modl'; did you mean model?"),
    (lambda: mp.load_scene({"type": "scene", "s": MISSPELT}), InputError, "did you mean focal_length?"),
])  # fmt: skip
def test_an_unknown_name_comes_with_the_one_that_it_resembles_if_any(call, error, words):
    with pytest.raises(error, match=words.replace("?", r"\?").replace("()", r"\(\)")):
        call()


def test_what_suits_is_taken():
    assert set(OPTIONS) <= set(inspect.signature(mp.reconstruct).parameters)
    assert mp.reconstruct(IMAGE.tolist(), np.array([240.0]), camera=CAMERA)[0].distance == 240
    for work in (mp.decode, mp.views.micro_images):
        work(Capture(IMAGE, CAMERA), white=Capture(mp.views.white_image(CAMERA), CAMERA))
    assert len(operator([(0, 0, -240)], virtual=True).points) == 1


class Tensor:
    """A tensor of another library as PyTorch's and JAX's behave: NumPy cannot have it."""

    def __init__(self, values, dtype="torch.float32", requires_grad=False):
        self.values, self.dtype, self.requires_grad = values, dtype, requires_grad

    def __len__(self):
        return len(self.values)

    def __array__(self, dtype=None, copy=None):
        if self.requires_grad:
            raise RuntimeError("Can't call numpy() on Tensor that requires grad.")
        if "bfloat16" in self.dtype:
            raise TypeError("Got unsupported ScalarType BFloat16")
        return np.array(self.values, dtype)


@pytest.mark.parametrize(
    ("kind", "words"),
    [({"requires_grad": True}, "it requires gradients"), ({"dtype": "torch.bfloat16"}, "of type bfloat16")],
)
def test_tensors_that_numpy_does_not_have(kind, words):
    image = Tensor(IMAGE, **kind)
    for name, call in {
        "image": lambda: Capture(image, CAMERA),
        "capture": lambda: mp.decode(image, camera=CAMERA),
        "weights": lambda: operator().forward([image]),
    }.items():
        refuses(f"^{name}.* ?{words}", call)
    assert Capture(Tensor(IMAGE), CAMERA).image.sum() == IMAGE.size


def test_small_numbers_may_become_zero_whatever_numpy_is_to_raise():
    with np.errstate(all="raise"):
        waves, rays = (captured(spp=2, model=model) for model in ("wave", "ray"))
        depth = mp.views.depth_map(mp.decode(mp.example("letters-ray")), 200, 300, planes=8)
    assert waves.image.mean() > 0 and rays.image.mean() > 0 and depth.depth.notnull().any()


def test_what_is_no_capture_or_no_plain_data_is_not_written(tmp_path):
    path = tmp_path / "raw.exr"
    refuses("capture of type ndarray: it must be a Capture", mp.write_capture, path, IMAGE)
    for fact in ({1, 2}, np.ones(3)):
        with pytest.raises(InputError, match=r"raw\.exr: its attributes must be plain data"):
            mp.write_capture(path, Capture(IMAGE, CAMERA, metadata={"fact": fact}))
    assert list(tmp_path.iterdir()) == []


OPTIONS = {
    "wavelength": 633,
    "interleave": 2,
    "footprint": "lens",
    "relay": True,
    "response": "ray",
    "iterations": 3,
    "accelerate": True,
    "photons": 100,
    "volume": False,
    "variation": 0.0,
    "checkpoint": mp.Checkpoint("none"),
    "batch_map": mp.runtime.batches.Threads(1),
}
TAKEN = {
    "ray": {"footprint"},
    "coherent": {"wavelength", "relay"},
    "partial": {"wavelength", "relay", "interleave"},
    "deconvolved": OPTIONS.keys() - {"interleave", "footprint", "relay"},
}


@pytest.mark.filterwarnings("ignore::mitsuba_plenoptic.PhysicsWarning")
@pytest.mark.parametrize(
    "method",
    [pytest.param(name, marks=[DECONVOLUTION, pytest.mark.slow]) if name == "deconvolved" else name for name in TAKEN],
)
def test_options_that_a_method_ignores_are_one_warning_even_at_their_defaults(method):
    unused = {name: value for name, value in OPTIONS.items() if name not in TAKEN[method]}
    taken = {"wavelength": 633} if method != "ray" else {}
    taken |= {"iterations": 1} if method == "deconvolved" else {}
    with pytest.warns(UserWarning, match=f"^method {method} has no use for ") as told:
        found = mp.reconstruct(IMAGE, 240, camera=CAMERA, method=method, **unused, **taken)
    (note,) = (str(one.message) for one in told if "has no use" in str(one.message))
    assert {part.split(" (")[0] for part in note.partition("has no use for ")[2].split("), ")} == set(unused)
    assert told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plain = mp.reconstruct(IMAGE, 240, camera=CAMERA, method=method, **taken)
    np.testing.assert_array_equal(found.image, plain.image)


def test_ray_captures_refuse_what_is_for_waves(tmp_path):
    unused = {"checkpoint": mp.Checkpoint(tmp_path / "none"), "batch_map": OPTIONS["batch_map"], "accuracy": 0.1}
    parts = {"integrator": {"type": "plenoptic_wave"}, "sensor": CAMERA.to_sensor(), "light": {"type": "constant"}}
    for loaded, model in ((scene(), None), (mp.load_scene({"type": "scene", **parts}), "ray")):
        for name, value in unused.items():
            refuses(f"^{name}: a ray capture does not take it", mp.render_capture, loaded, model=model, **{name: value})
    refuses(r"^batch_map: a ray capture does not take it", mp.estimate_capture, scene(), batch_map=unused["batch_map"])


RANDOM = np.random.default_rng(0).random((64, 64), np.float32)
LIGHT_FIELD = mp.decode(RANDOM, camera=CAMERA)
REFOCUSED = mp.reconstruct(IMAGE, 240, camera=CAMERA)
WRITERS = {
    "x.exr": lambda path: mp.write_capture(path, Capture(RANDOM, CAMERA)),
    "r.exr": lambda path: write_reconstruction(path, dataclasses.replace(REFOCUSED, image=RANDOM)),
    "v.tif": lambda path: write_volume(path, Volume(RANDOM[None], (240.0,), 0.1)),
    "x.png": lambda path: mp.write_raw(path, NOISY),
    "x.tiff": lambda path: mp.write_raw(path, NOISY),
    "lf.nc": lambda path: save_light_field(path, LIGHT_FIELD),
    "lf.mat": lambda path: save_light_field(path, LIGHT_FIELD),
    "lf.png": lambda path: write_mosaic(path, LIGHT_FIELD),
    "c.csv": lambda path: mp.calibration.write_corners(path, mp.calibration.Table("c", CORNERS)),
}
CORNERS = dict.fromkeys(("k", "l", "u", "v", "cluster", "frame"), np.arange(3000))
NEEDS = {"lf.mat": "raw", "c.csv": "calibrate"}
NAMES = [
    pytest.param(name, marks=pytest.mark.needs_extension(NEEDS[name])) if name in NEEDS else name for name in WRITERS
]


@pytest.mark.parametrize("name", NAMES)
def test_writers_refuse_names_of_other_kinds_of_file(name, tmp_path):
    for wrong in ("x.txt", "x", "x.exr.gz"):
        refuses(rf"{wrong}: give a name that ends in \.", WRITERS[name], tmp_path / wrong)
    assert list(tmp_path.iterdir()) == []
    WRITERS[name](tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", NAMES)
def test_what_a_disk_has_no_room_for_is_named_and_leaves_what_was_there(name, tmp_path):
    """As of a full disk, here of a limit on the size of files."""
    resource = pytest.importorskip("resource")
    path = tmp_path / name
    path.write_bytes(b"before")
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, before[1]))
    try:
        with pytest.raises(InputError) as caught:
            WRITERS[name](path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert str(caught.value).startswith(f"{path}: it cannot be written: ")
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]
