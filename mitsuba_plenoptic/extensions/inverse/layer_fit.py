"""Fits of a scene's textured planes to raw captures, by gradients through the camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import choices
from ...errors import InputError, argument, refuse_if, require_choice, require_count, require_number, suggest_keywords
from ...io import Capture
from ...runtime import drjit_array, one_at_a_time
from .layers import Layers


@suggest_keywords
@one_at_a_time
def fit_layers(
    captures: Sequence[Capture],
    to_world: Sequence[Any],
    start: Layers,
    *,
    model: str | None = None,
    rounds: int = 40,
    rate: float = 0.03,
    spp: int = 16,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> Layers:
    """Find the radiance and opacity of planes that explain raw captures of a scene from several positions.

    The raw micro-images are compared directly, without decoding into views. The mean squared difference is reduced by
    Adam's method (Kingma and Ba 2015), with one step for each capture of a round, and with gradients through the camera
    in the ray or wave model. Each step, and its gradient, uses new rays. The planes are not smoothed.

    Parameters
    ----------
    captures : sequence of Capture
        The captures, each with its camera, and its wavelength for the wave model.
    to_world : sequence of mitsuba.ScalarTransform4f
        Camera to world of each capture.
    start : Layers
        The planes, and where the fit starts. Texels of opacity 0 behind others get no gradient: start with a little.
    model : {"ray", "wave"}, optional
        Model of the light in the camera. Default: that of the captures.
    rounds : int
        Number of times that all captures are used.
    rate : float
        Largest change of a texel in a step, in units of radiance and opacity, at the start. It falls to a tenth.
    spp : int
        Samples per pixel of each step.
    seed : int
        Seed of the random numbers.
    progress : callable, optional
        Called after each round with the round's number and root mean square difference, which includes rendering noise.

    Returns
    -------
    Layers
        The planes with other texels.

    Raises
    ------
    InputError
        If an input is out of range, the numbers of captures and positions differ, a capture has other channels than the
        planes, or the variant has no derivatives.
    """
    refuse_if(
        not captures or len(captures) != len(to_world),
        f"captures and {argument('to_world')}: {len(captures)} and {len(to_world)}: give one position for each capture",
    )
    chosen = [require_choice("model", model or capture.model, choices.MODELS) for capture in captures]
    channels = start.radiance.shape[-1]
    for number, capture in enumerate(captures):
        found = capture.image.shape[2] if capture.image.ndim == 3 else 1
        refuse_if(found != channels, f"captures: number {number} has {found} channels, the planes have {channels}")
    rounds, rate = require_count("rounds", rounds), require_number("rate", rate, positive=True)
    spp, seed = require_count("spp", spp), require_count("seed", seed, minimum=0)
    sensors = []
    for capture, pose in zip(captures, to_world, strict=True):
        described = capture.camera.to_sensor(pose)
        if capture.image.ndim == 3 and capture.image.shape[2] == 3:
            described["film"]["pixel_format"] = "rgb"
        sensors.append(mi.load_dict(described, parallel=False))
    scene = start.scene(sensors[0])
    planes = scene.integrator()
    integrators = [_through(planes, capture, kind) for capture, kind in zip(captures, chosen, strict=True)]
    images = [capture.image.reshape(*capture.camera.shape, -1) for capture in captures]
    variables = {f"{index}": drjit_array(mi.TensorXf, each) for index, each in enumerate(start.texels)}
    optimizer = mi.ad.Adam(lr=rate, params=variables)
    random = np.random.default_rng(seed)
    most = np.append(np.full(start.radiance.shape[-1], np.inf, np.float32), np.float32(1))
    for done in range(rounds):
        optimizer.set_learning_rate(rate * 0.1 ** (done / rounds))
        total = 0.0
        for index in random.permutation(len(captures)).tolist():
            planes.set_texels(list(optimizer.values()))
            seeds = random.integers(2**32, size=2).tolist()
            with dr.suspend_grad():
                made = np.array(integrators[index].render(scene, sensors[index], seed=seeds[0], spp=spp))
            difference = made - images[index]
            total += float(np.mean(np.square(difference))) / len(captures)
            slope = drjit_array(mi.TensorXf, 2 * difference / difference.size)
            integrators[index].render_backward(scene, None, slope, sensors[index], seed=seeds[1], spp=spp)
            optimizer.step()
            for name, value in list(optimizer.items()):
                optimizer[name] = drjit_array(mi.TensorXf, np.clip(np.array(value), 0, most))
        if progress:
            progress(done + 1, total**0.5)
    texels = np.stack([np.array(value) for value in optimizer.values()])
    return replace(start, radiance=texels[..., :-1], opacity=texels[..., -1])


def _through(planes: Any, capture: Capture, model: str) -> Any:
    """Return the integrator that captures planes by a light model."""
    if model == "ray":
        return planes
    if capture.wavelength is None:
        raise InputError("capture: its wavelength is not known, which the wave model needs: set Capture.wavelength")
    wavelengths = np.atleast_1d(capture.wavelength).tolist()
    wavelength = wavelengths[0] if len(wavelengths) == 1 else ", ".join(map(str, wavelengths))
    return mi.load_dict({"type": "plenoptic_wave", "wavelength": wavelength, "child": planes})
