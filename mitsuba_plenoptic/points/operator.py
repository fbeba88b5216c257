"""The wave camera as a linear operator from weights of incoherent points to the detector's image, with its adjoint."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..camera import NOT_ROUND, PlenopticCamera, Round, Use, require_camera, require_support
from ..detector import SHARP, DetectorOperator
from ..errors import InputError, refuse_if, require_choice, require_flag, require_wavelength, suggest_keywords
from ..extension import hook
from ..fields import OpticalSystem
from ..io import digest
from ..linear import LinearMap
from ..optics import Spectrum, guards
from ..runtime import Array, Cost, Doubles, Floats, Job, LongSum, Progress, SumTask, cost_of, one_at_a_time
from .accuracy import chosen_accuracy
from .coherent_points import CoherentPoints
from .derivatives import DerivativePlan, Differentials, check_changes, check_names
from .full_fields import FullFieldPlan
from .mixing import SpectralSum, WavelengthPlans, WeightChannels, mix
from .patch_plan import PatchPlan
from .pupil_weights import PupilWeights
from .sampling import check_positions
from .shifted_fields import ShiftedPlan
from .units import brightness_at

PLANS: dict[str, type] = {"patch": PatchPlan, "full_field": FullFieldPlan}
"""Methods of computing point spreads at one wavelength, by name: the types of their plans.

A plan is made for an optical system, points, their pupil weights and an accuracy. It offers `sum`, `gather` and
`check_memory`, as `PatchPlan` does.
"""

METHODS = tuple(PLANS)

_PLACES = 33
"""Places across the recorded pixels at which this distance is measured."""


class CaptureOperator(CoherentPoints, LinearMap):
    r"""The image that a camera records of incoherent point sources, as a linear function of the points' weights.

    .. math:: I = A w, \qquad I_p = \sum_r w_r \, \mathrm{psf}_r(p)

    where psf is the fraction of the power through the visible pupil that falls on the pixel p. `vignetting` and
    `mla_transmissions` of the camera dim point spreads. All data that do not depend on the weights are computed on
    first use, and cached.

    It is a `scipy.sparse.linalg.LinearOperator`, which SciPy's solvers and PyLops take: ``operator @ weights`` and
    ``operator.T @ image`` are `forward` and `adjoint` of flattened arrays, of the shapes `source_shape` (n,) or (n,
    wavelengths) and `image_shape`. Without a spectrum several columns are multiplied at once.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; its recorded window may be a crop.
    points : array (n, 3)
        Scene points (X, Y, g) in the camera frame, in millimetres, in front of the main lens.
    wavelength : float, optional
        Wavelength in nanometres, the same for all channels of the weights. Give either this or `spectrum`.
    spectrum : Spectrum, optional
        Wavelengths, and the channels that record them. Weights then have a value for each wavelength. Point spreads are
        computed for each wavelength, or for each of the spectrum's nodes.
    method : {"patch", "full_field"}
        Method of computing point spreads: each on the part of the array that its point lights, or each on the whole
        array, without shortcuts. In the Fourier arrangement the method "patch" computes one for all points of a depth.
    accuracy : float, optional
        Allowed relative error (L2, over the image of all points, against that of 0) of the method "patch", below 1;
        0.01 by default. Points of nearly the same wavefront at neighbouring lenses may then share a point spread.
        Single point spreads of more than 512 points, and sums of a few of them, can have larger errors. With 0 every
        point has a spread of its own, and most of the diffracted light is retained. The method "full_field" allows no
        error but 0.
    pupil_weights : array (n, m, m), optional
        Relative power of each point over the square around the pupil, cut into m x m cells: rows along y, columns along
        x of the camera frame; booleans mark the visible part. The power is normalised, so that each point spread still
        sums to its weight.
    virtual : bool
        Whether points with g < 0 are allowed: images behind the main lens to which light converges in front of it, as
        after a lens of the scene.
    system : OpticalSystem, optional
        The camera bound to the wavelength, if other sums use it, too, so that its data are computed only once.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> camera = mp.PlenopticCamera(detector_width=0.128, resolution=(64, 64))
    >>> points = [(0.0, 0.0, 236.0), (0.05, 0.02, 240.0)]  # millimetres
    >>> operator = mp.CaptureOperator(camera, points, wavelength=633)
    >>> image = operator.forward([1.0, 2.0])
    >>> image.shape, operator.adjoint(image).shape
    ((64, 64), (2,))
    >>> operator.shape, (operator @ [1.0, 2.0]).shape
    ((4096, 2), (4096,))
    """

    @suggest_keywords
    def __init__(
        self,
        camera: PlenopticCamera,
        points: Any,
        *,
        wavelength: float | None = None,
        spectrum: Spectrum | None = None,
        method: str = "patch",
        accuracy: float | None = None,
        pupil_weights: Any = None,
        virtual: bool = False,
        system: OpticalSystem | None = None,
    ):
        if (wavelength is None) == (spectrum is None):
            raise InputError("wavelength, spectrum: give one of the two")
        camera = _as_regular(require_camera(camera))
        # An aperture that is not round is the power of every point's light over the pupil. The detector acts on sums.
        open_ = camera.replace(**NOT_ROUND, **SHARP)
        self.camera, self.points = camera, check_positions(points, camera, virtual=require_flag("virtual", virtual))
        self.spectrum = spectrum
        self._channels = WeightChannels(None if wavelength is None else require_wavelength(wavelength), spectrum)
        require_choice("method", method, METHODS)
        require_support(camera, Use.FULL_FIELDS if method == "full_field" else Use.POINTS)
        refuse_if(
            bool(camera.lens_data.traced_surfaces) and method == "full_field" and pupil_weights is not None,
            f"pupil_weights: method {method} takes none behind a main_lens; use patch",
        )
        self._detector = DetectorOperator.of(camera)
        self._has_lengths = bool(camera.detector_blur or camera.stray_width)
        self._method, self._accuracy = method, chosen_accuracy(accuracy, method)
        self._pupil_weights = PupilWeights.of(pupil_weights, len(self.points))
        if camera.aperture != Round():
            refuse_if(pupil_weights is not None, "pupil_weights: points through apertures that are not round take none")
            self._pupil_weights = PupilWeights.through(camera.aperture, len(self.points))
        system = system if camera == open_ else None
        if system is not None:
            bound = system.wavelength
            refuse_if(
                bound != wavelength or system.camera != camera.at_wavelength(bound),
                f"system: it is bound to another camera, or to {bound:g} nm, not {wavelength}",
            )
        systems = {} if system is None else {system.wavelength: system}
        planned_for = self.points, self._pupil_weights, self._accuracy
        plan = ShiftedPlan if method == "patch" and camera.lens_data.images_stop else PLANS[method]
        self._plans = WavelengthPlans(plan, open_, *planned_for, systems)
        self._differentials: Differentials | None = None
        wavelengths = 1 if spectrum is None else len(spectrum.wavelengths)
        channels = 1 if spectrum is None else spectrum.channels
        LinearMap.__init__(
            self,
            (len(self.points), wavelengths)[: 1 + (wavelengths > 1)],
            (*camera.shape, channels)[: 2 + (channels > 1)],
        )

    @cached_property
    def coherent_fields(self) -> Any:
        """The fields of the points at the operator's only wavelength; several wavelengths are refused."""
        wavelengths = [spectral_sum.wavelength for spectral_sum in self._channels.parts(1)]
        refuse_if(len(wavelengths) > 1, f"spectrum of {len(wavelengths)} wavelengths: a coherent field has one")
        refuse_if(
            self.spectrum is not None and self.spectrum.matrix().tolist() != [[1]],
            "spectrum: a coherent field has no channels and no response; give the wavelength",
        )
        require_support(self.camera, Use.COHERENT_POINTS)
        refuse_if(self._pupil_weights is not None, "pupil_weights: coherent fields take none")
        make = hook("coherent fields", "field")
        return make(self._plans.system_at(wavelengths[0]), self.points)

    def powers(self, light: Any) -> Doubles:
        """Return the weights with which images have the unit of captures of scenes, for one wavelength.

        Parameters
        ----------
        light : array (n,)
            Radiance of each point times the solid angle that it covers, seen from the main lens's image side.
        """
        (wavelength,) = {spectral_sum.wavelength for spectral_sum in self._channels.parts(1)}
        return brightness_at(self._plans.system_at(wavelength), self.points) * light

    @one_at_a_time
    def forward(self, weights: Any, *, job: Job | None = None) -> Floats:
        """Return the image: the sum of the point spreads of all points, each with a weight.

        Except on CUDA, the bits of the result depend neither on the number of threads or workers, nor on whether the
        sum was resumed.

        Parameters
        ----------
        weights : array (n,) or (n, channels)
            Factors on the point spreads, of any sign. With a spectrum of several wavelengths one column for each of
            them, or one for all.
        job : Job, optional
            Executor of the work, progress report and checkpoint. Default: threads of this process.

        Returns
        -------
        array (rows, columns) or (rows, columns, channels)
            Integrals over the recorded pixels, float32 or of the ``dtype`` of a `StoredOperator`.

        Raises
        ------
        PhysicsError
            If too much of the light is lost (see `optics.guards`).
        """
        with guards.watch():
            image = self._detector.forward(self._image(self._check(weights), job or Job()))
        return image[..., 0] if np.ndim(weights) == 1 and image.shape[2] == 1 else image

    def _image(self, weights: Doubles, job: Job) -> Array:
        """Return the image (rows, columns, channels) of checked weights (n, columns)."""
        _, matrix = self._channels.mixing(weights.shape[1])
        pupils = self._pupil_weights
        arrays = [None] * 3 if pupils is None else [pupils.table, pupils.index, pupils.slant]
        facts = {
            "camera": self.camera.to_dict,
            "spectrum": self._channels.light,
            "method": self._method,
            "accuracy": self._accuracy,
            "points_digest": lambda: digest(self.points, weights, *arrays),
        }
        shape = (*self.camera.shape, len(matrix))
        items = self.sums * len(self.points)
        return job.run(self.tasks(weights, job), shape, items, facts)

    @one_at_a_time
    def adjoint(self, image: Any, *, job: Job | None = None) -> Doubles:
        """Return each point spread's inner product with an image: the transpose of `forward` applied to the image.

        Parameters
        ----------
        image : array (rows, columns) or (rows, columns, channels)
            Values of the recorded pixels.
        job : Job, optional
            Executor of the work and progress report.

        Returns
        -------
        float64 array (n,) or (n, channels)
            Products with the point spreads; with a spectrum of several wavelengths one column for each of them.
        """
        channels = self._detector.adjoint(self._channels.check_image(image, self.camera.shape, self.dtype))
        wavelengths, _ = self._channels.mixing(channels.shape[2])
        result = np.zeros((len(self.points), len(wavelengths)))
        with guards.watch():
            parts = self._channels.parts(channels.shape[2])
            for spectral_sum, products in self._products(channels, parts, job or Job()):
                result += products @ spectral_sum.before.T
        return result[:, 0] if np.ndim(image) == 2 and len(wavelengths) == 1 else result

    def _products(self, image: Array, parts: Iterator[SpectralSum], job: Job) -> Iterator[tuple[SpectralSum, Array]]:
        """Yield the products (n, k) of an image (rows, columns, channels) with the point spreads of each sum."""
        count = len(self.points)
        for index, spectral_sum in enumerate(parts):
            channels = mix(image, spectral_sum.after.T)
            plan = self._plans.checked(spectral_sum.wavelength, job, channels.shape[2])
            yield spectral_sum, plan.gather(channels, job, index * count, self.sums * count)

    @one_at_a_time
    def derivative(self, weights: Any, changes: dict[str, Any], *, job: Job | None = None) -> Floats:
        """Return the derivative of `forward` along changes of the camera's parameters.

        Points, weights, the relative power over each pupil and the total power through it are fixed. Each point has its
        own spread behind a real main lens, for up to 512 points, and at accuracies below 0.004; otherwise points share
        spreads as in `forward`, and each copy includes the changes in its lenses. The method must be "patch", and
        cameras with an objective are not supported.

        Parameters
        ----------
        weights : array (n,) or (n, channels)
            As for `forward`.
        changes : dict
            Change of each parameter that changes, by name: ``focal_length``, ``aperture_radius``, ``mla_distance``,
            ``mla_focal_length`` (one, or each of three), ``mla_pitch`` (of both, or of each), ``mla_rotation`` (in
            degrees), ``mla_offset`` (two), ``mla_fill``, ``detector_distance``, ``detector_width``, ``wavelength`` (in
            nanometres, of all) and ``wavefront`` (the first of its coefficients, or all; behind a real main lens over
            the ``pupil_radius`` of its exit pupil).
        job : Job, optional
            Progress report; the work is done by threads of this process.

        Returns
        -------
        float32 array
            Derivative, of the shape of the image.
        """
        return np.asarray(self.jacobian(weights, [changes], job=job)[0])

    @one_at_a_time
    def jacobian(self, weights: Any, directions: Sequence[dict[str, Any]], *, job: Job | None = None) -> Floats:
        """Return the derivatives of `forward` in several directions, with the fields computed once for all.

        Parameters
        ----------
        weights, job
            As for `derivative`.
        directions : sequence of dict
            Changes of the camera's parameters in each direction, as for `derivative`.

        Returns
        -------
        float32 array (directions, ...)
            The derivatives, each of the shape of the image.
        """
        factors = self._check(weights)
        checked = [check_changes(self.camera, changes) for changes in directions]
        refuse_if(not checked, "directions: give at least one")
        wavelengths, matrix = self._channels.mixing(factors.shape[1])
        image = self._for_derivatives().jvp(factors, checked, wavelengths, matrix, job or Job())
        image = self._detector.forward(image.reshape(*self.camera.shape, -1))
        columns = np.moveaxis(image.reshape(*self.camera.shape, len(checked), len(matrix)), 2, 0)
        growths = [changes.get("detector_width", np.zeros(1)) for changes in checked]
        if any(map(np.any, growths)) and self._has_lengths:
            columns += np.multiply.outer(np.concatenate(growths), self._slope_by_width(factors))
        flat = np.ndim(weights) == 1 and len(matrix) == 1
        return np.ascontiguousarray(columns[..., 0] if flat else columns)

    @one_at_a_time
    def gradient(
        self, weights: Any, image_gradient: Any, names: Iterable[str] | None = None, *, job: Job | None = None
    ) -> dict[str, Doubles]:
        """Return a scalar's gradient with respect to camera parameters, from its gradient with respect to the image.

        One reverse pass through all point spreads serves all parameters.

        Parameters
        ----------
        weights : array (n,) or (n, channels)
            As for `forward`.
        image_gradient : array
            Derivatives of the scalar by the pixels, of the shape of the image.
        names : iterable of str, optional
            The parameters. Default: all.
        job : Job, optional
            Progress report; the work is done by threads of this process.

        Returns
        -------
        dict
            The derivatives of the scalar by name, float64 arrays: two for ``mla_pitch`` (along the rows and across
            them; add the two if both pitches are one parameter) and for ``mla_offset``, one for each
            ``mla_focal_length``, 36 or more for ``wavefront``, and one for all others. `adjoint` gives the derivatives
            by the weights.
        """
        factors = self._check(weights)
        chosen = check_names(self.camera, names)
        channels = self._detector.adjoint(self._channels.check_image(image_gradient, self.camera.shape))
        wavelengths, matrix = self._channels.mixing(factors.shape[1])
        if channels.shape[2] != len(matrix):
            raise InputError(f"image of shape {np.shape(image_gradient)}: the weights make {len(matrix)} channels")
        gradients = self._for_derivatives().vjp(factors, channels, chosen, wavelengths, matrix, job or Job())
        if "detector_width" in gradients and self._has_lengths:
            slope = self._slope_by_width(factors)
            gradients["detector_width"] += np.vdot(slope, np.reshape(image_gradient, slope.shape))
        return gradients

    def _slope_by_width(self, weights: Doubles) -> Array:
        """Return what the detector's lengths, as counts of pixels, add to the derivative by ``detector_width``."""
        with guards.watch():
            return np.asarray(self._detector.slope(self._image(weights, Job())) / self.camera.detector_width)

    def _for_derivatives(self) -> Differentials:
        """Return the derivatives of the sums; refuse methods without derivatives."""
        refuse_if(self._method != "patch", f"method = {self._method}: it has no derivatives; use patch")
        require_support(self.camera, Use.POINT_DERIVATIVES)
        if (spectrum := self._channels.spectrum) is not None and spectrum.nodes:
            raise InputError(
                f"spectrum: nodes = {spectrum.nodes}: there are no derivatives between nodes; leave them out"
            )
        if self._differentials is None:
            self._differentials = Differentials(
                self.camera.replace(**SHARP), len(self.points), self._plans.made_by(DerivativePlan)
            )
        return self._differentials

    def estimate(self, job: Job | None = None) -> Cost:
        """Return the estimated cost of `forward`, which is begun, and abandoned as soon as its speed is known.

        Parameters
        ----------
        job : Job, optional
            Executor of the work.
        """

        def begin(progress: Progress) -> Floats:
            return self.forward(np.ones(self.source_shape), job=Job(progress, job.batch_map if job else None))

        return cost_of(begin)

    def _matmat(self, weights: Array) -> Array:
        """Return the images (pixels, k) of several columns of weights, which share their spreads."""
        if self.spectrum is not None:
            return super()._matmat(weights)
        return self.forward(weights).reshape(-1, weights.shape[1])

    def _rmatmat(self, pixels: Array) -> Array:
        """Return the products (n, k) with several images (pixels, k)."""
        if self.spectrum is not None:
            return super()._rmatmat(pixels)
        return self.adjoint(pixels.reshape(*self.camera.shape, -1))

    @property
    def sums(self) -> int:
        """Number of sums of point spreads in an image: one for each distinct wavelength, or for each node."""
        return self._channels.sums

    def tasks(self, weights: Doubles, job: Job) -> Iterator[SumTask]:
        """Yield the sum at each distinct wavelength, for weights (n, channels or wavelengths)."""
        for spectral_sum in self._channels.reduced_parts(weights, self._accuracy):

            def plan(spectral_sum: SpectralSum = spectral_sum) -> LongSum:
                channels = weights @ spectral_sum.before
                return self._plans.checked(spectral_sum.wavelength, job, channels.shape[1]).sum(channels)

            yield SumTask(len(self.points), plan, partial(mix, matrix=spectral_sum.after))

    def _check(self, weights: Any) -> Doubles:
        """Return weights as an array (n, columns); refuse anything else."""
        return self._channels.check_weights(weights, len(self.points))


def _as_regular(camera: PlenopticCamera) -> PlenopticCamera:
    """Return the camera, of a regular array if lenses that `mla_cra` shifts are as good as regular."""
    regular = camera.regular
    if regular is camera:
        return camera
    pixels = (camera.pixel_coordinates(axis) for axis in (0, 1))
    x, y = (np.linspace(float(places[0]), float(places[-1]), _PLACES) for places in pixels)
    cells = camera.lattice.cell(*np.meshgrid(x, y))
    apart = np.subtract(camera.lattice.centre(*cells), regular.lattice.centre(*cells))
    # 0.01: Largest distance in pixels of shifted lenses from regular ones that stand for them, behind which spreads
    # repeat.
    return regular if np.hypot(*apart).max() < 0.01 * camera.pixel_size else camera
