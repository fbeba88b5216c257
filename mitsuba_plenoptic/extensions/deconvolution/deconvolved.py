"""Deconvolution: the planes whose simulated capture equals the recorded one, by Richardson and Lucy's iteration.

It stops where only noise is left in the residual, weighted by the variances of the pixels, or where the excess of the
residual over noise hardly falls any more.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ...design import resolution_limit
from ...errors import argument, refuse_if, refusing, require_number
from ...io import digest
from ...linear import LinearMap, PixelNoise, RichardsonLucy, SolverState, StopRule, misfit, relative_residual, solve
from ...refocus import Found, Task, method, portion, work_of
from ...runtime import Floats, Job, Named
from .fourier import FourierResponse, response_of
from .response import Response
from .variation import TotalVariation

DEFAULT_ITERATIONS = 30
MOST_ITERATIONS = 100
"""Steps where nothing is known of the noise, and at most where it is."""


LEAST_SEEN = 0.01
"""Light of a bin, over that of the best one, below which it is NaN."""


@method("deconvolved", waves=True, as_it_is=True, long=True, as_recorded=True)
def refocus(task: Task, **options: Any) -> list[Found]:
    """Return planes found by inverting the camera's response with Richardson and Lucy's iteration.

    Each plane alone explains the whole capture, or all planes together as a volume; light from other distances is
    attributed to these planes. See `mitsuba_plenoptic.linear.solver`.

    Returns
    -------
    list of Found
        The radiance of each plane, with facts.
    """
    noise = noise_of(task.exposure, options["photons"])
    _require_light(task.image, noise)
    planes = range(len(task.distances))
    groups = [[plane] for plane in planes]
    if options["volume"]:
        groups = [list(planes)]
        for index, distance in enumerate(task.distances):
            refuse_if(
                distance in task.distances[:index],
                f"distance = {distance:g}: it is given twice; the planes of a volume are different ones",
            )
    arrays = {}
    if task.checkpoint:
        begun = task.checkpoint.begin_arrays(
            capture=digest(task.image),
            camera=task.camera.to_dict(),
            distances=list(task.distances),
            oversample=task.oversample,
            wavelengths=list(task.wavelengths),
            exposure=task.exposure,
            options=options,
            white=None if task.white is None else digest(task.white),
        )
        arrays = begun or {}
    with refusing("checkpoint: it is damaged:", KeyError, ValueError):
        solved = [
            Solved(arrays[f"image.{index}"], int(done), float(left), bool(stopped))
            for index, (done, left, stopped) in enumerate(arrays.get("solved", np.zeros((0, 3))))
        ]
    # Channels of one wavelength, or by rays, share a response.
    lights = [None] * task.image.shape[2] if options["response"] == "ray" else task.wavelengths
    runs = [list(run) for _, run in itertools.groupby(range(len(lights)), lights.__getitem__)]
    works = list(itertools.product(runs, groups))
    order = [(plane, channel) for run, group in works for channel in run for plane in group]
    done = len(solved)
    refuse_if(
        done > len(order) or done % len(groups[0]),
        f"checkpoint: it is damaged: {done} planes are no part of {len(order)}",
    )
    amounts = work_of(task.wavelengths) or [1.0] * len(lights)
    most = options["iterations"] or (MOST_ITERATIONS if noise else DEFAULT_ITERATIONS)
    for index, (run, group) in enumerate(works):
        left = [channel for channel in run if (group[0], channel) in order[done:]]
        if not left:
            continue
        report = portion(task.progress, index, [sum(amounts[channel] for channel in some) for some, _ in works])
        with response_of(task.camera)(
            task.camera,
            [task.distances[plane] for plane in group],
            wavelength=lights[left[0]],
            oversample=task.oversample,
            job=Job(progress=lambda done, total, report=report: report(done / total), batch_map=task.batch_map),  # type: ignore[misc]
            steps=most * len(left),
        ) as response:
            shares = [response.prepared, *[(1 - response.prepared) / len(left)] * len(left)]
            for number, channel in enumerate(left, start=1):
                stepped = portion(report, number, shares)
                solved += list(_solve(task, response, channel, options, most, noise, solved, arrays, stepped))
                # Only the first of them had been begun.
                arrays = {}
    images = dict(zip(order, solved, strict=True))
    by_plane = [[images[plane, channel] for channel in range(len(lights))] for plane in planes]
    return [
        Found(np.stack([plane_image.image for plane_image in of_plane], axis=-1), _facts(task, distance, of_plane))
        for distance, of_plane in zip(task.distances, by_plane, strict=True)
    ]


def noise_of(exposure: Named | None, photons: float | None) -> PixelNoise | None:
    """Return the noise for `photons`, if given, otherwise for the exposure that `expose` recorded."""
    if photons is not None:
        return PixelNoise(require_number("photons", photons, positive=True))
    return None if exposure is None else PixelNoise.of_exposure(exposure)


def until_noise(noise: PixelNoise) -> StopRule:
    """Return the rule that ends steps where only noise is left, or where 10 leave more than 0.95 of what is above."""
    return StopRule(lambda image, model: misfit(noise, image, model) - 1, 0.0, 10, 0.95)


@dataclass(frozen=True, eq=False)
class Solved:
    """Result of deconvolution for one channel of one plane."""

    image: Floats
    iterations: int
    residual: float
    stopped: bool


class _Flat(LinearMap):
    """A response whose pixels record a part of the light, each its own, 0 if left out, as bins send a part of it."""

    def __init__(self, response: LinearMap, flat: Floats, bright: Any = 1):
        super().__init__(response.source_shape, response.image_shape)
        self._response = response
        self.flat = flat
        self.bright = bright

    def forward(self, values: NDArray, /) -> NDArray:
        """Return the pixels lit by bins."""
        return self._response.forward(values * self.bright) * self.flat

    def adjoint(self, image: NDArray, /) -> NDArray:
        """Return the transpose of `forward`, applied to pixels."""
        return self._response.adjoint(image * self.flat) * self.bright


def flat_field(
    response: Response | FourierResponse, white: Floats, is_recorded: bool = True, bright: Any = 1
) -> Floats:
    """Return what pixels record over a response's light, by their white; 0 where a recorded one is far from that."""
    computed = response.forward(np.full(response.source_shape, bright / len(response.shapes), np.float32))
    # A recorded white says nothing of darker pixels; a computed one does of all that steps use.
    lit = computed > (0.03 if is_recorded else 0.005) * computed.max()
    ratio = np.divide(white, computed, out=np.ones_like(computed), where=lit)
    if not is_recorded:
        return ratio.clip(0, 20).astype(np.float32)
    ratio /= np.median(ratio[lit & (white > 0)])
    # Pixels behind dust are left out. Micro-images of lenses of another brightness are no dust.
    return np.where(lit, np.where(abs(ratio - 1) < 0.15, ratio, 0), 1).astype(np.float32)


def _balanced(response: Response | FourierResponse, white: Floats) -> _Flat:
    """Return a response with the computed white image and, where the pupil changes, with the known light of bins.

    Each changes the other, in four rounds less and less.
    """
    operator = _Flat(response, flat_field(response, white, False))
    light_of_bins = response.light
    for _ in range(0 if light_of_bins is None else 4):
        light = operator.adjoint(np.ones(response.image_shape, np.float32))
        more = np.divide(cast(Floats, light_of_bins), light, out=np.ones_like(light), where=light > 1e-3 * light.max())
        bright = (operator.bright * more).clip(0.5, 2)
        operator = _Flat(response, flat_field(response, white, False, bright), bright)
    return operator


def _solve(
    task: Task,
    response: Response | FourierResponse,
    channel: int,
    options: Named,
    most: int,
    noise: PixelNoise | None,
    solved: Sequence[Solved],
    arrays: Mapping[str, NDArray],
    report: Callable[[float], None],
) -> Iterator[Solved]:
    """Yield the result of each plane for one channel, from the state in a checkpoint's arrays if there is one."""
    # What rounding leaves below 0 is no light; noise may be.
    image = np.maximum(task.image[..., channel], -np.inf if noise else 0)
    variation = options["variation"]

    facts = np.array([[one.iterations, one.residual, one.stopped] for one in solved], np.float64).reshape(-1, 3)
    images = {f"image.{index}": one.image for index, one in enumerate(solved)}

    def save(state: SolverState) -> None:
        if task.checkpoint:
            task.checkpoint.save_arrays(lambda: {"solved": facts, **images, **state.arrays()})

    operator = response
    if task.white is not None:
        operator = _Flat(response, flat_field(response, task.white[..., channel]))
    elif task.computed is not None:
        operator = _balanced(response, task.computed[..., channel])
    if isinstance(operator, _Flat):
        image = np.where(operator.flat > 0, image, 0)
    steps = RichardsonLucy(
        operator,
        image,
        noise.shift if noise else 0.0,
        TotalVariation(response.planes_of, variation) if variation else None,
    )
    solution = solve(
        steps,
        iterations=most,
        accelerate=options["accelerate"],
        stop=until_noise(noise) if noise and options["iterations"] is None else None,
        state=SolverState.of(arrays, response.source_shape),
        save=save,
        progress=lambda done, total: report(done / total),
    )
    residual = relative_residual(image, solution.model)
    brightness = steps.light / steps.light.max()
    for plane in range(len(response.shapes)):
        radiance, light = (response.to_image(values, plane) for values in (solution.point, brightness))
        visible = np.where(light >= LEAST_SEEN, radiance, np.float32(np.nan))
        yield Solved(visible, solution.iterations, residual, bool(solution.stopped))


def _facts(task: Task, distance: float, of_plane: Sequence[Solved]) -> Named:
    """Return the facts about a plane that results state."""
    wavelengths: Sequence[float | None] = task.wavelengths or [None]
    limits = [resolution_limit(task.camera, distance, wavelength) for wavelength in wavelengths]
    return {
        "iterations": max(channel.iterations for channel in of_plane),
        "residual": max(channel.residual for channel in of_plane),
        "stopped_by_noise": all(channel.stopped for channel in of_plane),
        "resolution_limit": min(limit.frequency for limit in limits),
        "in_focus": any(limit.in_focus for limit in limits),
    }


def _require_light(image: Floats, noise: PixelNoise | None) -> None:
    """Refuse a capture that no light can have produced, as its sum is not positive."""
    refuse_if(not (image > 0).any(), "capture: none of its pixels is lit: there is nothing to deconvolve")
    negative = np.count_nonzero(image < -1e-6 * image.max())  # what rounding leaves
    refuse_if(
        noise is None and negative,
        f"capture: {negative} of its pixels are below 0, the least of them {image.min():.3g}: no light makes these; "
        f"their noise is known from {argument('photons')} or from what 'expose' keeps with a capture",
    )
    refuse_if(
        image.sum(dtype=np.float64) <= 0,
        "capture: the sum of its pixels is not above 0: there is no light to deconvolve",
    )
