"""``mitsuba-plenoptic particles``: captures of particles in a flow, with exact displacements."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...cli import inputs, options, options_of, stopping
from ...errors import naming, refuse_if, refusing, require_choice, require_known, short_repr
from ...runtime import progress_bar

if TYPE_CHECKING:
    from .flows import Flow


def particles(
    *,
    output: options.OutputFolder,
    volume: str,
    flow: str,
    camera: options.CameraFile | None = None,
    photons: float | None = None,
    resume: options.Resume = False,
    sequence: Annotated[
        dict[str, Any], options_of("extensions.particles.sequence:particle_sequence", "interval", "frames", "seed")
    ],
    seeding: Annotated[dict[str, Any], options_of("extensions.particles.seeding:Seeding")],
    direction: str = "1,0,0",
    thickness: float | None = None,
    light: Annotated[
        dict[str, Any], options_of("extensions.particles.particle_images:ParticleImages", "model", "accuracy")
    ],
    wavelength: options.Wavelength = 550.0,
) -> None:
    """Capture particles in a flow at several times, with their exact displacements.

    Writes the folder's particles.nc, NetCDF with all positions and displacements, and a capture of each frame, such as
    wave_0000.exr. The same command with another model captures the same particles. Pixels are in units of a mean
    particle, the sum of whose pixels is 1. 'expose' records captures with other detectors than the one of --photons.

    Parameters
    ----------
    volume : X,Y,Z,X,Y,Z
        Two corners of the box with the particles, in mm of the camera's frame.
    flow : NAME[:KEY=VALUE,...]
        The flow: uniform, shear, taylor_green, lamb_oseen, hill, or file:FILE.nc; its parameters, such as
        hill:speed=4,radius=5, in mm and mm/s; its centre=X/Y/Z is that of the volume by default.
    direction : X,Y,Z
        Direction in which the light of the sheet travels.
    thickness
        Thickness in millimetres of the light sheet, across the axis. Default: light everywhere.
    wavelength
        Wavelength in vacuum, in nanometres.
    photons
        Record with noise: photons of a mean particle through the pupil. Default: without noise.

    Examples
    --------
    $ mitsuba-plenoptic particles -o pair --volume -6,-6,230,6,6,250 --per-lens 0.05
      --flow hill:speed=4,radius=5 --interval 0.1
    $ mitsuba-plenoptic particles -o pair --volume -6,-6,230,6,6,250 --per-lens 0.05
      --flow hill:speed=4,radius=5 --interval 0.1 --model ray --photons 1e5
    """
    from ...camera import PlenopticCamera
    from ...detector import Detector, expose
    from ...io import write_capture, write_labelled_data
    from .flows import FLOWS
    from .particles import LightSheet, ParticleImages, ParticleVolume, Seeding, particle_sequence

    corners = _numbers("volume", volume, 6)
    box = ParticleVolume(corners[:3], corners[3:])
    truth = particle_sequence(
        inputs.named_camera(camera) or PlenopticCamera(),
        box,
        Seeding(**seeding),
        _flow(flow, FLOWS, box.centre),
        sheet=LightSheet(_numbers("direction", direction, 3), thickness),
        **sequence,
    )
    images = ParticleImages(truth, wavelength=wavelength, **light)
    with refusing(f"{output}: no folder can be made there", OSError):
        output.mkdir(parents=True, exist_ok=True)
    path = output / "particles.nc"
    write_labelled_data(path, truth)
    lit = int((truth["inside"][0].values * (truth["irradiance"][0].values > 0)).sum())
    typer.echo(f"{path}: {truth.sizes['particle']} particles, {lit} of them lit in the first frame")
    model = light["model"]
    frames = sequence["frames"]
    for frame in range(frames):
        path = output / f"{model}_{frame:04d}.exr"
        with stopping.checkpoint_of(path, resume) as saved, progress_bar(f"Frame {frame + 1} of {frames}") as progress:
            saved.run = {"photons": photons}
            with stopping.resumable(progress, saved):
                capture = images.capture(frame, progress=progress, checkpoint=saved)
            if photons is not None:
                capture = expose(capture, Detector(), photons=photons, seed=sequence["seed"] + frame)
            write_capture(path, capture)
        typer.echo(f"{path}: capture by {model}s at {float(truth['time'][frame]):g} s")


def _numbers(name: str, text: str, count: int) -> tuple[float, ...]:
    """Return the numbers of an option, separated by commas."""
    rule = f"{name} = {short_repr(text)}: it must be {count} numbers, separated by commas"
    with refusing(rule, ValueError):
        values = tuple(map(float, text.split(",")))
    refuse_if(len(values) != count, rule)
    return values


def _flow(text: str, flows: Mapping[str, Callable[..., Flow]], centre: tuple[float, ...]) -> Flow:
    """Return the flow that an option states, as NAME:KEY=VALUE,..., with numbers of a vector separated by slashes.

    Where the option states no centre, it is the given one.
    """
    name, _, settings = text.partition(":")
    kind = flows[require_choice("flow", name, tuple(flows))]
    if name == "file":
        return kind(settings)
    names = tuple(inspect.signature(kind).parameters)
    values: dict[str, Any] = {"centre": centre} if "centre" in names else {}
    for setting in filter(None, settings.split(",")):
        key, equals, value = setting.partition("=")
        refuse_if(not equals, f"flow = {short_repr(text)}: write it as NAME:KEY=VALUE,KEY=VALUE")
        require_known(f"flow: {name}: ", [key], names)
        numbers: list = value.split("/")
        with contextlib.suppress(ValueError):
            numbers = [float(number) for number in numbers]
        values[key] = numbers[0] if len(numbers) == 1 else tuple(numbers)
    with naming(f"flow: {name} (vectors with slashes, as 1/0/0.5)"):
        return kind(**values)
