r"""Linear estimates of Zernike terms from the pixels of a capture, by the interaction matrix of the wave model.

Near a reference wavefront a capture of known points that counts N photons is

.. math:: y = N (r + J a) + n

with the reference r and the interaction matrix J, whose columns are the derivatives of the capture by the terms a. The
photon noise n has the variance N r. The estimate minimises

.. math:: \sum_p \frac{(y_p / N - r_p - (J a)_p)^2}{r_p / N} + \sum_j \frac{a_j^2}{\sigma_j^2}

(Tikhonov; the maximum a posteriori for terms of the standard deviations sigma), or its first sum alone over the
directions that the pixels determine best (truncated singular values). It holds for changes of about a tenth of a wave;
`fit_wavefronts` has no such limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...camera import PlenopticCamera
from ...errors import InputError, refuse_if, require_accuracy, require_count, require_wavelength, suggest_keywords
from ...points import CaptureOperator
from ...runtime import Doubles, as_array, as_pixels
from .wavefront_fit import Zone, require_zone


@dataclass(frozen=True)
class InteractionMatrix:
    """The capture of known points, and its derivatives with respect to Zernike terms.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera, with the reference wavefront.
    reference : float64 array (rows, columns)
        Capture of the known points, with a sum of 1.
    responses : float64 array (modes - 1, rows, columns)
        Derivatives of the capture, by the second Zernike term and those that follow.
    """

    camera: PlenopticCamera
    reference: Doubles
    responses: Doubles

    @classmethod
    @suggest_keywords
    def of(
        cls, camera: PlenopticCamera, zone: Zone, *, modes: int = 36, wavelength: float = 633.0, accuracy: float = 0.01
    ) -> InteractionMatrix:
        """Return the interaction matrix of a camera for known points.

        Parameters
        ----------
        camera : PlenopticCamera
            The camera; its ``wavefront`` is the reference.
        zone : Zone
            The points.
        modes : int
            Number of Zernike terms, the piston included, which is not estimated; from 2 to 36.
        wavelength : float
            Wavelength in nanometres.
        accuracy : float
            As for `CaptureOperator`.
        """
        count = require_count("modes", modes, minimum=2, maximum=36)
        wavelength = require_wavelength(wavelength)
        require_zone(zone)
        operator = CaptureOperator(camera, zone.points, wavelength=wavelength, accuracy=require_accuracy(accuracy))
        weights = operator.powers(zone.weights)
        image = np.asarray(operator.forward(weights), np.float64)
        refuse_if(not image.sum() > 0, "zone: the detector records no light of it")
        directions = [{"wavefront": term} for term in np.eye(count)[1:]]
        responses = np.asarray(operator.jacobian(weights, directions), np.float64)
        return cls(camera, image / image.sum(), responses / image.sum())

    def estimate(self, image: Any, *, prior: Any = None, rank: int | None = None) -> Doubles:
        """Return the Zernike terms by which the wavefront of a capture differs from the reference.

        Parameters
        ----------
        image : array (rows, columns)
            Capture in counted electrons, whose sum is taken for the number N.
        prior : float or array (modes - 1,), optional
            Expected standard deviation of each term, in waves. Default: unknown.
        rank : int, optional
            Number of directions of the terms that are estimated, from the best determined on. The other directions stay
            0. Default: all.

        Returns
        -------
        float64 array (modes,)
            The terms in the unit and order of the camera's ``wavefront``.
        """
        pixels = as_pixels("image", image, np.float64)
        refuse_if(
            pixels.shape != self.reference.shape,
            f"image of shape {pixels.shape}: the matrix is of {self.reference.shape}",
        )
        photons = float(pixels.sum())
        refuse_if(photons <= 0, "image: it is black: nothing can be found by it")
        refuse_if(prior is not None and rank is not None, "prior, rank: give one of the two")
        count = len(self.responses)
        # 1.0: Photons at least that are expected in a pixel when it is weighted, as in fits.
        weight = photons / np.sqrt(np.maximum(photons * self.reference, 1.0))
        rows = (self.responses * weight).reshape(count, -1).T
        misfit = ((pixels / photons - self.reference) * weight).ravel()
        left, singular, right = np.linalg.svd(rows, full_matrices=False)
        if prior is None:
            directions = require_count("rank", count if rank is None else rank, maximum=count)
            terms = right[:directions].T @ (left.T[:directions] @ misfit / singular[:directions])
        else:
            deviation = as_array("prior", prior)
            if deviation.shape not in ((), (count,)) or not (np.isfinite(deviation) & (deviation > 0)).all():
                raise InputError(f"prior of shape {deviation.shape}: it must be positive, one or {count} numbers")
            terms = np.linalg.solve(rows.T @ rows + np.diag(np.ones(count) / deviation**2), rows.T @ misfit)
        return np.concatenate([[0.0], terms])
