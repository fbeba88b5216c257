"""Check of this machine's installation: what rendering needs, and whether it suffices.

Variants are tried, since what they load shows with the first scene only: OptiX is a part of NVIDIA's driver that is
often missing, in containers above all, where CUDA alone works.
"""

import os
import platform
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import drjit
import mitsuba

from ..runtime import DEFAULT_VARIANT, fft, llvm

_MISSING = "not installed"

OPTIX = (
    "OptiX, by which Mitsuba traces rays on CUDA, is a part of NVIDIA's driver, 535 or newer; a container needs "
    "NVIDIA_DRIVER_CAPABILITIES=all, and WSL 2 Mitsuba's instructions for it"
)
"""What to look at where a CUDA variant fails; the documentation of Mitsuba 3.9 states the driver."""

TRIAL_SECONDS = 60.0
"""Time that a variant is given to render a triangle, its kernels not compiled yet."""

# The triangle lies in the plane z = 0, and the camera 4 above it: the middle of the picture is at this depth.
_TRIANGLE = """
import sys
import mitsuba as mi
mi.set_variant(sys.argv[1])
triangle = mi.Mesh("triangle", vertex_count=3, face_count=1)
parameters = mi.traverse(triangle)
parameters["vertex_positions"] = [-2, -2, 0, 2, -2, 0, 0, 2, 0]
parameters["faces"] = [0, 1, 2]
parameters.update()
sensor = {
    "type": "perspective", "fov": 10, "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
    "film": {"type": "hdrfilm", "width": 3, "height": 3, "rfilter": {"type": "box"}},
}
scene = mi.load_dict({"type": "scene", "integrator": {"type": "depth"}, "sensor": sensor, "triangle": triangle})
depth = float(mi.TensorXf(mi.render(scene, spp=1))[1, 1, 0].array[0])
if not abs(depth - 4) < 0.5:
    sys.exit(f"a triangle at a distance of 4 is rendered at {depth:g}")
"""


@dataclass(frozen=True)
class Installation:
    """State of an installation: versions, variants and problems."""

    # Titles, each with the names and findings below it.
    sections: dict[str, list[tuple[str, str]]]
    # Why LLVM variants cannot be used.
    problem: str | None
    # The variants that rendered a triangle.
    working: list[str]

    @property
    def ready(self) -> bool:
        """Whether the default variant renders here."""
        return DEFAULT_VARIANT in self.working

    @property
    def verdict(self) -> str:
        """Whether captures can be rendered, and how, in one sentence."""
        if self.ready:
            return "Ready to render"
        if not self.working:
            return "Not ready: no variant renders here"
        name = "cuda_ad_mono" if "cuda_ad_mono" in self.working else self.working[0]
        return f"Not ready: {DEFAULT_VARIANT}, the default variant, does not render here; --variant {name} does"


def inspect_installation() -> Installation:
    """Return versions, LLVM, GPU and Mitsuba's variants of this installation; what may work renders a triangle."""
    problem = llvm.problem()
    cuda = bool(drjit.has_backend(drjit.JitBackend.CUDA))
    python = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    names = [name for name in mitsuba.variants() if "_ad_" in name]
    tried = [name for name in names if (cuda if name.startswith("cuda") else not problem)]
    with ThreadPoolExecutor(fft.worker_count()) as pool:
        faults = dict(zip(tried, pool.map(trial, tried), strict=True))
    packages = ("mitsuba-plenoptic", "mitsuba", "drjit", "numpy", "scipy", "OpenEXR")
    sections = {
        "Versions": [("python", python), *((name, _version(name)) for name in packages)],
        "LLVM": _llvm(),
        "GPU": _gpu(cuda, faults),
        "Variants": [(name, _state(name, faults)) for name in names],
    }
    return Installation(sections, problem, [name for name in tried if not faults[name]])


def trial(variant: str) -> str:
    """Return why a variant does not render a triangle, an empty text where it does.

    It is rendered in a process of its own, which may abort, or never end.
    """
    command = [sys.executable, "-c", _TRIANGLE, variant]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=TRIAL_SECONDS)
    except subprocess.TimeoutExpired:
        return f"no answer within {TRIAL_SECONDS:g} s"
    if answer.returncode == 0:
        return ""
    errors = answer.stderr.strip().splitlines()
    if answer.returncode < 0:
        return f"ended by {signal.Signals(-answer.returncode).name}" + (f" after: {errors[-1]}" if errors else "")
    return errors[-1] if errors else f"exit status {answer.returncode}"


def _state(variant: str, faults: Mapping[str, str]) -> str:
    """Return a sentence on whether a variant works here, and which of its functions wave captures use."""
    if variant not in faults:
        return "not usable here"
    if faults[variant]:
        return f"fails here: {faults[variant]}"
    if "polarized" in variant:
        return "works here; wave captures are unpolarized"
    return "works here"


def _llvm() -> list[tuple[str, str]]:
    installed = [
        f"{item.path}: {item.version_text}, "
        + ("usable" if item.usable else f"too old, {llvm.MINIMUM} or newer is needed")
        for item in llvm.candidates()
    ]
    named = os.environ.get(llvm.VARIABLE)
    loaded = tuple(drjit.detail.llvm_version())
    return [
        *(("found", text) for text in installed),
        ("chosen", f"{llvm.VARIABLE}={named}" if named else "none, left to Dr.Jit"),
        ("loaded", llvm.format_version(loaded) if loaded > (0,) else "none"),
        ("threads", str(drjit.thread_count())),
    ]


def _gpu(cuda: bool, faults: Mapping[str, str]) -> list[tuple[str, str]]:
    releases = (_version(name) for name in ("cupy-cuda12x", "cupy-cuda13x", "cupy"))
    cupy = next((release for release in releases if release != _MISSING), None)
    device = "no NVIDIA driver"
    if shutil.which("nvidia-smi"):
        command = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
        answer = subprocess.run(command, capture_output=True, text=True, check=False)
        lines = answer.stdout.strip().splitlines() if answer.returncode == 0 else []
        device = lines[0].replace(", ", ", driver ") if lines else device
    optix = [fault for name, fault in faults.items() if name.startswith("cuda")]
    return [
        ("device", device),
        ("CUDA", "found" if cuda else "not found"),
        *([("OptiX", f"fails; {OPTIX}" if all(optix) else "works")] if optix else []),
        (
            "CuPy",
            cupy or f"{_MISSING}; for waves on CUDA: pip install cupy-cuda12x, or cupy-cuda13x by the driver's CUDA",
        ),
    ]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return _MISSING
