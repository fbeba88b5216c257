r"""Captures of points whose light adds coherently, averaged over realisations of their random phases.

A rough surface gives the light of each of its points a random phase. One realisation of the phases is one speckle
pattern; its intensity has a negative exponential distribution of contrast 1. Light of N modes that do not interfere
makes N independent patterns, whose mean has the contrast :math:`1 / \sqrt N` (J. W. Goodman, "Speckle Phenomena in
Optics", 2007, chapters 3 and 6). The mean over all realisations is the incoherent capture.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, refuse_if, require_count, suggest_keywords
from ...io import digest
from ...optics import guards
from ...points import CaptureOperator, recorded_pixels
from ...runtime import POINTS, Doubles, Floats, Job, Part, PartialSum, SumTask, as_array, one_at_a_time, require_all
from .coherent import CoherentFields

_BRIGHTEST = 1e30
"""Largest power of a point, whose intensities are held in single precision."""


@suggest_keywords
@one_at_a_time
def coherent_capture(
    operator: CaptureOperator, weights: Any, *, modes: int = 1, seed: int = 0, job: Job | None = None
) -> NDArray[np.float32]:
    r"""Average the intensities of several realisations of mutually coherent points with random phases.

    .. math:: I_p = \frac{1}{N} \sum_{n=1}^N \int_p \Big| \sum_r \sqrt{w_r} \, e^{i \varphi_{rn}} \, u_r \Big|^2

    with the fields :math:`u_r` of `CaptureOperator.field`, and phases :math:`\varphi_{rn}` that are independent and
    uniform: those of rough surfaces, whose heights differ by more than a wavelength. The mean over many modes is
    `CaptureOperator.forward` of the same weights. For the statistics of fully developed speckle, a resolved spot of the
    camera must hold many points: the contrast is smaller by about 1 / 5 n for n points in a square of side
    :math:`\lambda g / D_1`.

    Parameters
    ----------
    operator : CaptureOperator
        The camera, the points and one wavelength.
    weights : array (n,)
        Power of each point through the pupil, at least 0, as in `CaptureOperator.forward`.
    modes : int
        N; see `mode_count`.
    seed : int
        Seed of the phases.
    job : Job, optional
        Progress report in modes, and checkpoint. Each mode is computed by all threads of this process.

    Returns
    -------
    float32 array (rows, columns)
        Integrals over the recorded pixels.

    Raises
    ------
    PhysicsError
        If too much of the light is lost.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> camera = mp.PlenopticCamera(detector_width=0.128, resolution=(64, 64), aperture_radius=2)
    >>> operator = mp.CaptureOperator(camera, [(-0.01, 0, 240), (0.01, 0, 240)], wavelength=633)
    >>> mp.laser.coherent_capture(operator, [1, 1], modes=2, seed=3).shape
    (64, 64)
    """
    if not isinstance(operator, CaptureOperator):
        raise InputError(f"operator of type {type(operator).__name__}: it must be a CaptureOperator")
    rule = "they must be numbers"
    powers = as_array("weights", weights, POINTS, rule=rule, shape=(len(operator.points),), least=0.0)
    require_all("weights", powers, powers <= _BRIGHTEST, f"at most {_BRIGHTEST:g}")
    count = require_count("modes", modes)
    seed = require_count("seed", seed, minimum=0, maximum=2**32 - 1)
    fields = operator.coherent_fields
    job = job or Job()
    refuse_if(job.batch_map is not None, "batch_map: a coherent capture takes none: all threads compute each mode")
    work = _Realisations(fields, np.sqrt(powers), count, seed)
    facts = {
        "camera": operator.camera.to_dict(),
        "wavelength": fields.system.wavelength,
        "modes": count,
        "seed": seed,
        "points_digest": digest(operator.points, powers),
    }
    with guards.watch():
        tasks = [SumTask(count, lambda: work, lambda image: image)]
        return job.run(tasks, (*operator.camera.shape, 1), count, facts)[..., 0]


@dataclass(frozen=True)
class _Realisation:
    """One realisation of the phases, as a batch of a computation."""

    fields: CoherentFields
    moduli: Doubles
    seed: tuple[int, int]
    scale: float

    @property
    def samples(self) -> int:
        """Number of samples on the detector."""
        return math.prod(self.fields.grids.count)

    def prepare(self) -> Callable[[], Part]:
        """Return a function that computes this realisation in one piece."""
        waves = np.random.default_rng(self.seed).random(len(self.moduli))
        amplitudes = (self.moduli * np.exp(2j * math.pi * waves)).astype(np.complex64)
        image = self.fields.intensity(amplitudes) * np.float32(self.scale)
        pixels = Part(recorded_pixels(self.fields.system.camera), image[None])
        return lambda: pixels


class _Realisations:
    """The mean over all realisations, with the interface of `runtime.batches.LongSum`."""

    channels = 1
    arrays: Any = np

    def __init__(self, fields: CoherentFields, moduli: Doubles, count: int, seed: int):
        self._fields = fields
        self._moduli = moduli
        self._seed = seed
        self.box = recorded_pixels(fields.system.camera)
        self.items = np.ones(count, np.int64)

    def batches(self, first: int) -> Iterator[_Realisation]:
        """Yield one batch for each realisation."""
        count = len(self.items)
        for mode in range(first, count):
            yield _Realisation(self._fields, self._moduli, (self._seed, mode), 1 / count)

    def image(self, total: PartialSum) -> Floats:
        """Return the image of the sums, with the channel as the last axis."""
        return np.ascontiguousarray(total.sums.transpose(1, 2, 0))
