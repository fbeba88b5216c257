"""A capture by waves: radiators and their point spreads, and what a kernel bank records by rays."""

from __future__ import annotations

import itertools
import logging
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..io.checkpoints import digest
from ..optics.fitted_lens import lens_of_rays
from ..optics.spectrum import Spectrum
from ..runtime.jobs import Job, Task
from .bank import (
    TOLERANCE,
    LensBank,
    finest_pitch,
    less_than_told,
    local_camera,
    local_vergences,
    near_weight,
    require_served,
)
from .choice import Probes, bank_is_better
from .estimate import estimate_waves
from .lens_rays import LensRaySum
from .noise import PARTS, keep_spread, keep_variances, with_halves, with_spread
from .operator import CaptureOperator
from .patch_plan import Cost
from .radiators import Radiators, find_radiators, sample_pairs
from .sight import Sight
from .units import radiance_weight

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class WaveCapture:
    """What is recorded, and how it is computed.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera.
    sight : Sight
        The scene.
    wavelengths : tuple of float
        Of each channel, in nanometres.
    radiators_per_lens, passes, method, occlusion, accuracy
        Parameters of the integrator ``plenoptic_wave``.
    """

    camera: PlenopticCamera
    sight: Sight
    wavelengths: tuple[float, ...]
    radiators_per_lens: int
    passes: int
    method: str
    occlusion: bool
    accuracy: float

    def compute(self, *, seed: int, spp: int, job: Job, noise: bool) -> NDArray[np.float32]:
        """Sum all radiators of all passes.

        Parameters
        ----------
        seed, spp, job, noise
            As of the integrator's `record`.

        Returns
        -------
        float32 array (rows, columns, channels)
            Pixel values, none negative; with noise twice as many channels, those of the standard deviations last.
        """
        method = self._chosen(seed)
        sets = self.radiators(method, seed, spp)
        # Columns of the weights: the capture's channels, and what tells the noise of each.
        columns = self.wavelengths + tuple(np.repeat(self.wavelengths, 1 + PARTS)) if noise else self.wavelengths
        operators = [self.operator(radiators, method, columns) for radiators in sets]
        rays = self._lens_rays(seed, spp, runs=PARTS if noise else 1) if method == "bank" else []
        total = sum(len(operator.points) * operator.sums for operator in operators)
        if total == 0 and not rays:
            warnings.warn(
                "plenoptic_wave: no ray from the pupil meets anything that shines; a nested integrator with "
                "hide_emitters sees no emitters",
                stacklevel=2,
            )
        if method != "full_field" and total:
            self._tell(operators[0].estimate(job), rays)
        channels = len(self.wavelengths)
        tasks = [_task(work, len(rays)) for work in rays]
        items = total + sum(task.items for task in tasks)
        shape = (*self.camera.shape, channels * (1 + noise * (3 if rays else 1)))
        if noise:
            tasks = [keep_spread(task) for task in tasks]
        generator = np.random.default_rng((seed, PARTS)) if noise else None
        sums = itertools.chain(self._sums(operators, sets, job, generator, shape[2]), tasks)
        image = job.run(sums, shape, items, partial(self.facts, sets, seed))
        if noise and rays:
            image = with_spread(image, len(rays))
        # What interpolation leaves below zero between the samples is not light.
        np.maximum(image, 0, out=image)
        np.sqrt(image[..., channels:], out=image[..., channels:])
        return image

    def estimate(self, *, seed: int, spp: int, job: Job) -> Cost:
        """Estimate what `compute` takes, from some of the lenses and some of the rays."""
        method = self._chosen(seed)
        cost = estimate_waves(
            self.camera,
            partial(find_radiators, self.sight, self.camera, weight=self._near(method), seed=seed),
            partial(self.operator, method=method, columns=self.wavelengths),
            job,
            pairs=sample_pairs(self.radiators_per_lens, np.zeros(4)),
            spp=spp,
            occlusion=self.occlusion,
        )
        rays = self._lens_rays(seed, spp, blank=True) if method == "bank" else []
        return self._whole(cost, rays)

    def _whole(self, cost: Cost, rays: list[LensRaySum]) -> Cost:
        """Return the cost of all passes, and of what the bank records, from that of one pass."""
        own = [work.cost() for work in rays[:1]]
        return replace(
            cost,
            radiators=cost.radiators * self.passes,
            patterns=cost.patterns * self.passes,
            seconds=cost.seconds * self.passes + len(rays) * sum(seconds for seconds, _ in own),
            memory=max([cost.memory, *(memory for _, memory in own)]),
        )

    def _tell(self, cost: Cost, rays: list[LensRaySum]) -> None:
        """Report what is to come."""
        cost = self._whole(cost, rays)
        _log.info(
            "%d radiators, %d point spreads, about %.0f s and %.1f GiB",
            cost.radiators,
            cost.patterns,
            cost.seconds,
            cost.memory / 2**30,
        )

    def _chosen(self, seed: int) -> str:
        """Return the method that is used; by the bank's rays, everything hides what is behind it."""
        if self.method != "auto":
            return self.method
        per_lens = self.passes * self.radiators_per_lens**2
        # A bank takes the main lens to be round, without added aberrations, and the same for all channels.
        better = (
            self.occlusion
            and self.camera.objective is None
            and not self._several_ways()
            and less_than_told(self.camera, max(self.wavelengths)) <= TOLERANCE
            and not any(self.camera.wavefront)
            and not (self.camera.glass or self.camera.mla_glass)
            and bank_is_better(self.camera, self.sight, max(self.wavelengths), per_lens, self.accuracy, seed)
        )
        return "bank" if better else "patch"

    def _several_ways(self) -> bool:
        """Whether light of different channels takes different ways through a real main lens."""
        return self.camera.prescription is not None and self.camera.is_dispersive and len(set(self.wavelengths)) > 1

    def _near(self, method: str) -> Any:
        """Return the function that tells how much of the light needs exact point spreads, None if all does."""
        if method != "bank":
            return None
        return lambda vergence: np.asarray(near_weight(self.camera, vergence, self.accuracy))

    def radiators(self, method: str, seed: int, spp: int, dark: bool = False) -> list[Radiators]:
        """Find the radiators of all passes.

        Parameters
        ----------
        method : str
            How their light is summed: what a bank records is left out.
        seed, spp
            As of `compute`.
        dark : bool
            Whether to keep those that do not shine.
        """
        # The first pass is not shifted: it is the best single set.
        shifts = [np.zeros(4), *np.random.default_rng(seed).random((self.passes - 1, 4))]
        seeds = np.random.SeedSequence(seed).generate_state(self.passes)
        return [
            find_radiators(
                self.sight,
                self.camera,
                sample_pairs(self.radiators_per_lens, shift),
                spp=spp,
                seed=int(pass_seed) >> 1,
                occlusion=self.occlusion,
                weight=self._near(method),
                dark=dark,
            )
            for shift, pass_seed in zip(shifts, seeds, strict=True)
        ]

    def operator(self, radiators: Radiators, method: str, columns: tuple[float, ...]) -> CaptureOperator:
        """Return the operator of the light of some radiators, with a wavelength for each column of their weights."""
        # What the bank records is left out of the radiators.
        return CaptureOperator(
            self.camera,
            radiators.positions,
            spectrum=Spectrum.lines(*columns),
            method="patch" if method == "bank" else method,
            accuracy=self.accuracy,
            pupil_weights=radiators.pupil_weights,
            virtual=True,
        )

    def _lens_rays(self, seed: int, spp: int, runs: int = 1, blank: bool = False) -> list[LensRaySum]:
        """Return the sums that record by rays through the lenses' centres what is out of focus, to be averaged.

        Blank ones record nothing, but tell what they take.
        """
        paths = spp * self.passes
        runs = min(runs, paths)
        prescription = self.camera.prescription
        if prescription is not None and self._several_ways():
            raise InputError(
                f"method = bank: main_lens = {prescription.name or 'prescription'} disperses light, of "
                "which a bank records one wavelength; use patch, or one wavelength"
            )
        require_served(self.camera, self.wavelengths[0])
        between = self.sight.vergences(lens_of_rays(self.camera))
        if (near_weight(self.camera, np.array(between), self.accuracy) == 1).all():
            return []  # all that can be seen is in focus
        types = range(len(self.camera.mla_focal_lengths))
        pitch, local = finest_pitch(self.camera, self.wavelengths), local_camera(self.camera)
        between = local_vergences(self.camera, between)
        banks = [
            [LensBank.learn(local, wavelength, self.accuracy, between, type_, pitch, blank) for type_ in types]
            # What one wavelength takes tells well enough what others do.
            for wavelength in (self.wavelengths[:1] if blank else self.wavelengths)
        ]
        if blank:
            banks *= len(self.wavelengths)
            # Coefficients of one table would be found once for all.
            banks = [[replace(bank, table=replace(bank.table)) for bank in of_channel] for of_channel in banks]
        # Neighbouring seeds must not share runs.
        seeds = np.random.SeedSequence([seed, runs]).generate_state(runs).tolist()
        options: dict[str, Any] = {
            "wavelength": self.wavelengths[0],
            "accuracy": self.accuracy,
            "spp": -(-paths // runs),
        }
        return [LensRaySum(self.camera, self.sight, banks, seed=run_seed, **options) for run_seed in seeds]

    def _sums(
        self,
        operators: list[CaptureOperator],
        sets: list[Radiators],
        job: Job,
        noise: np.random.Generator | None,
        channels: int,
    ) -> Iterator[Task]:
        """Yield the radiators' sums of all passes; what an operator has planned goes when its pass is done."""
        for radiators in sets:
            operator = operators.pop(0)
            scale = self.scale(radiators)
            weights = scale * radiators.radiance
            if noise is None:
                yield from operator.tasks(weights, job)
                continue
            deviations = scale * np.sqrt(radiators.variance)
            halves = [with_halves(column, noise) for column in deviations.T]
            groups = [
                [channel for channel, other in enumerate(self.wavelengths) if other == wavelength]
                for wavelength in dict.fromkeys(self.wavelengths)
            ]
            tasks = operator.tasks(np.hstack([weights, *halves]), job)
            for task, own in zip(tasks, groups, strict=True):
                yield keep_variances(task, own, len(self.wavelengths), channels)

    def facts(self, sets: list[Radiators], seed: int) -> dict[str, Any]:
        """Return by what a capture is known as the same: its radiators, and the light along some rays."""
        probes = Probes.of(self.camera, self.sight, seed)
        arrays: list[np.ndarray | None] = [probes.radiance, probes.vergence]
        for radiators in sets:
            weights = radiators.pupil_weights
            arrays += [radiators.positions, radiators.radiance, radiators.fraction]
            arrays += [None] * 3 if weights is None else [weights.table, weights.index, weights.slant]
        return {"radiators": sum(len(radiators.positions) for radiators in sets), "scene_digest": digest(*arrays)}

    def scale(self, radiators: Radiators) -> NDArray[np.float64]:
        """Return the weights (n, 1) of radiators of radiance 1."""
        camera = self.camera
        cell = camera.lattice.cell_area / (self.radiators_per_lens**2 * self.passes)
        return np.asarray(radiance_weight(camera, cell) / radiators.fraction[:, None])


def _task(work: LensRaySum, runs: int) -> Task:
    """Return one of some sums of which the mean is taken."""
    return Task(int(work.items.sum()), lambda: work, lambda image: image * np.float32(1 / runs))
