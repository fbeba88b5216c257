r"""Captures of scenes by signed rays: plan, noise, and derivatives with respect to the scene's parameters.

A capture is linear in the radiances of its rays, so its change is the same sum over their changes. In reverse, the
correlations of the kernels with the gradient of a function of the capture are gradients of the cells' mean values, and
Dr.Jit differentiates `SignedRaySum.estimate`, which makes these of the radiances, batch by batch.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import ClassVar, TypeVar

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera, Values
from ..detector import PARTS, NonNegative, keep_spread, variance_left, with_spread
from ..errors import warn
from ..io import digest
from ..optics import Spectrum
from ..runtime import Doubles, Floats, Job, Sizes, SumTask, check_memory, steps_counted
from ..scene import LightDerivatives, ReplayedLight, SceneLight
from .expansion import ExpandedPlan, nearby
from .phase_space import FINE, PhaseSpace
from .scheme import Plan, plan_of
from .signed_camera import CameraAdjoint, CameraTangents
from .signed_rays import SignedRaySum, memory_of
from .spectral_nodes import Node, WavelengthSampler, node_spectra

Sum = TypeVar("Sum", bound=SignedRaySum)

_TRACING = 0.9
"""Approximate fraction of a capture's time in which rays are traced; then their images are convolved."""

_STEPS = 6.1
"""Approximate work of the steps of the plan of a node."""

_REPORTED = 10**6
"""What is reported as the total of progress."""


@dataclass(frozen=True)
class SignedCapture:
    """A capture by signed rays: camera, light, spectrum, and accuracy."""

    camera: PlenopticCamera
    # Radiance along rays.
    light: SceneLight
    # Wavelengths, and the channels' responses.
    spectrum: Spectrum
    # Matrix (values, wavelengths) from the values of a ray's light to its spectrum; or, if light has its own spectrum,
    # the sampler of the rays' wavelengths.
    conversion: Doubles | WavelengthSampler
    # Count of wavelengths at which diffraction is computed, see `node_spectra`.
    node_count: int | None
    accuracy: float
    # Camera parameters by which the capture is differentiated.
    varying: tuple[str, ...] = ()

    has_gradients: ClassVar[bool] = True
    """Whether derivatives of the capture can be computed."""

    @cached_property
    def nodes(self) -> list[Node]:
        """The nodes, with their plans, which are expanded where parameters are varied."""
        start = self._start
        weights = self.weights
        shortest = weights[0][0]
        longest = weights[-1][0]

        def plans(beside_far: bool) -> list[Plan]:
            return [
                plan_of(start.at_wavelength(node), node, self.accuracy < FINE, shortest, longest, beside_far)
                for node, _, _ in weights
            ]

        # Dispersing microlenses may be in focus at some nodes alone.
        of_nodes = plans(False)
        if len({plan.lands_by_point for plan in of_nodes}) > 1:
            of_nodes = plans(True)
        nodes = []
        for plan, (wavelength, channels, of_node) in zip(of_nodes, weights, strict=True):
            if self.varying and isinstance(plan, PhaseSpace) and not plan.lands_by_point:
                plan = ExpandedPlan.about(plan, self.camera.at_wavelength(wavelength))
            nodes.append(Node(plan, channels, of_node))
        return nodes

    @cached_property
    def _start(self) -> PlenopticCamera:
        """The camera about which plans are expanded where parameters are varied."""
        return nearby(self.camera, self.varying, self.accuracy)

    @cached_property
    def weights(self) -> list[tuple[float, Sizes, Doubles]]:
        """Each node's wavelength and channels, and the weights of a ray's values in the channels: see `Node`."""
        conversion = self.conversion
        wavelengths = np.array(self.spectrum.wavelengths)
        responses = np.asarray(self.spectrum.matrix(), np.float64)
        if isinstance(conversion, WavelengthSampler):
            wavelengths = conversion.edges
            responses = conversion.responses
        weights: dict[float, Doubles] = {}
        for channels, spectrum in node_spectra(self._start, self.spectrum, self.accuracy, self.node_count):
            for node, share in zip(spectrum.computed, spectrum.shares(wavelengths), strict=True):
                weights.setdefault(node, np.zeros(responses.shape))[channels] = responses[channels] * share
        result = []
        for node, values in sorted(weights.items()):
            if not isinstance(conversion, WavelengthSampler):
                values = values @ conversion.T
            lit = np.flatnonzero(values.any(1))
            result.append((node, tuple(lit.tolist()), values[lit]))
        return result

    @property
    def kind(self) -> type:
        """The kind of the sums of which a capture is the mean."""
        if self.camera.lens_data.images_stop:
            from .stop_sum import StopSum

            return StopSum
        return SignedRaySum

    def sums(
        self, spp: int, seed: int, runs: int, kind: Callable[..., Sum], light: Callable[..., list] | None = None
    ) -> list[Callable[[], Sum]]:
        """Return functions that construct the sums of `runs` independent captures, which divide the rays equally.

        The functions allow the memory of one sum to be freed before the next is made. By default, the light is that of
        the capture.
        """
        make = partial(self._sum(kind), self.camera, light or self.light, self.nodes, spp=-(-spp // runs))
        # Captures with neighbouring seeds must not share runs.
        seeds = np.random.SeedSequence([seed, runs]).generate_state(runs).tolist()
        return [partial(make, seed=of_run) for of_run in seeds]

    def _sum(self, kind: Callable[..., Sum]) -> Callable[..., Sum]:
        """Return a kind of sum with the wavelengths and the cells of the grid of this capture."""
        wavelengths = self.conversion if isinstance(self.conversion, WavelengthSampler) else None
        shortest = min((node.plan for node in self.nodes), key=lambda plan: plan.wavelength)
        return partial(kind, wavelengths=wavelengths, parts=shortest.parts(self.accuracy < FINE))

    def compute(self, *, seed: int, spp: int, job: Job, noise: bool) -> Floats:
        """Return the light on the pixels (rows, columns, channels), with the deviations of what pixels make of it."""
        # 4: Samples per pixel of each capture from whose spread the noise is estimated: fewer correct each other less.
        runs = max(2, min(PARTS, spp // 4)) if noise else 1
        progress = job.progress
        rows, columns = self.camera.shape
        check_memory(
            memory_of(float(rows) * columns, float(rows) * columns * spp, [len(on) for _, on, _ in self.weights]),
            f"wave capture of {columns} x {rows} pixels, nodes = {len(self.weights)}",
            most=math.inf,
        )

        def show(done: float) -> None:
            if progress:
                progress(round(_REPORTED * done), _REPORTED)

        planned = 0.0
        path = getattr(job.keeper, "path", None)
        # The progress of a resumed run begins with what is done.
        if progress and not (path and path.exists()):
            # Plans are a larger part of the work the fewer rays there are.
            plans = _STEPS * len(self.weights)
            # 1.5e-6: Approximate work of a ray.
            planned = plans / (plans + 1.5e-6 * math.prod(self.camera.shape) * spp)
        reached = {"traced": 0.0, "convolved": 0.0}

        def report(label: str, count: float) -> None:
            reached[label] = count
            reached["traced"] = max(reached.values())
            done = _TRACING * reached["traced"] + (1 - _TRACING) * reached["convolved"]
            show(planned + (1 - planned) * done / items_of_all)

        traced = (lambda more: report("traced", reached["traced"] + more)) if progress else None
        with steps_counted(lambda done: show(planned * done) if planned else None, _STEPS * len(self.weights)):
            sums = self.sums(spp, seed, runs, partial(self.kind, traced=traced))
            first = sums[0]()
        items = int(first.items.sum())
        if runs == 1:
            sums = [lambda: first]

        tasks = [SumTask(items, plan, lambda image: image * np.float32(1 / runs)) for plan in sums]
        if noise:
            tasks = [keep_spread(task, self.camera) for task in tasks]
        channels = self.spectrum.channels
        shape = (rows, columns, channels * (3 if noise else 1))
        items_of_all = items * runs
        job = replace(job, progress=lambda done, _: report("convolved", done))
        image = job.run(tasks, shape, items_of_all, {"scene_digest": lambda: digest(first.probe())})
        if not image.any():
            warn(
                "plenoptic_wave: none of the rays meets anything that shines; plain BSDFs are black from "
                "behind, and a nested integrator with hide_emitters sees no emitters"
            )
        if noise:
            image = with_spread(image, runs)
        for channel, projection in self.projections(image).items():
            image[..., channel] = projection.image
            if noise:
                image[..., channels + channel] *= variance_left(projection, image[..., channels + channel], self.camera)
        np.maximum(image[..., channels:], 0, out=image[..., channels:])
        np.sqrt(image[..., channels:], out=image[..., channels:])
        return image

    def projections(self, image: Floats) -> dict[int, NonNegative]:
        """Return the compensated images of channels that only noise can make negative, by channel."""
        channels = np.flatnonzero(self.spectrum.matrix().min(1) >= 0).tolist()
        return {channel: NonNegative(image[..., channel]) for channel in channels}


@dataclass(frozen=True)
class SignedGradients:
    """The derivatives of a signed-ray capture, with the rays that `compute` draws."""

    capture: SignedCapture
    # The derivatives of its light; None means that the light does not change.
    light: LightDerivatives | None
    seed: int
    spp: int

    @cached_property
    def compensated(self) -> tuple[Floats, dict[int, NonNegative]]:
        """The light on the pixels (rows, columns, channels), and the compensation of its noise by channel."""
        with dr.suspend_grad():
            image = self._image(self.capture.kind)
        projections = self.capture.projections(image)
        for channel, projection in projections.items():
            image[..., channel] = projection.image
        return image, projections

    def forward(self, changes: Values) -> Floats:
        """Return the change of the light on the pixels, an array (rows, columns, channels)."""
        with dr.suspend_grad():
            change = np.zeros((*self.capture.camera.shape, self.capture.spectrum.channels), np.float32)
            if self.light is not None:
                change += self._image(self.capture.kind, self.light)
            if changes:
                change += self._image(partial(CameraTangents, changes=changes))
            for channel, projection in self.compensated[1].items():
                change[..., channel] = projection.forward(change[..., channel])
        return change

    def backward(self, gradient: Floats, names: Sequence[str]) -> Values:
        """Return the gradients of the camera's parameters; gradients of scene parameters accumulate in Dr.Jit.

        Shapes: `gradient` (rows, columns, channels).
        """
        with dr.suspend_grad():
            linear = list(np.moveaxis(gradient, -1, 0))
            for channel, projection in self.compensated[1].items():
                linear[channel] = projection.backward(linear[channel])
            if self.light is not None:
                light = ReplayedLight(self.light)
                for _ in self._sum(self.capture.kind, light).propagate(linear):
                    light.propagate()
            return self._sum(partial(CameraAdjoint, names=names)).backward(linear) if names else {}

    def _sum(self, kind: Callable[..., Sum], light: Callable[..., list] | None = None) -> Sum:
        return self.capture.sums(self.spp, self.seed, 1, kind, light)[0]()

    def _image(self, kind: Callable[..., SignedRaySum], light: LightDerivatives | None = None) -> Floats:
        """Return the image of one kind of sum, an array (rows, columns, channels)."""
        work = self._sum(kind, light)
        items = int(work.items.sum())
        shape = *self.capture.camera.shape, self.capture.spectrum.channels
        return Job().run([SumTask(items, lambda: work, lambda image: image)], shape, items)
