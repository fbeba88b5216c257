"""Relations of maps that have transposes or derivatives: fields, responses, and refocusing as a function."""

import numpy as np
from camera_draws import Draw
from relation import off, relation

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.camera.entry import Use
from mitsuba_plenoptic.detector import DetectorOperator
from mitsuba_plenoptic.extensions.deconvolution.response import Response
from mitsuba_plenoptic.extensions.inverse.point_rays import PointRays
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.refocus import CoherentRefocus, DeconvolvedRefocus, RayRefocus


def apart(made, y, x, back):
    """Return how far <A x, y> is from <x, A' y>, over the sizes of A x and y."""
    one, other = (np.vdot(np.asarray(b, np.complex128), a) for a, b in ((made, y), (x, back)))
    return float(abs(one - other) / (np.linalg.norm(made) * np.linalg.norm(y)))


def random_image(draw: Draw, shape):
    return draw.rng.uniform(0.5, 1.5, shape).astype(np.float32)


@relation(Use.POINT_FIELDS | Use.COHERENT_POINTS | Use.POINTS, "main_lens", "coherent fields")
def fields(draw):
    """Fields have their adjoint, on any plane."""
    points, plane = [draw.point(), draw.point()], str(draw.rng.choice(["pupil", "array", "detector"]))
    # Smaller pupils have fewer samples.
    camera = draw.camera.replace(aperture_radius=draw.camera.aperture_radius / 2)
    operator = mp.CaptureOperator(camera, points, wavelength=draw.wavelength, method="full_field")
    given = draw.rng.normal(size=2) + 1j * draw.rng.normal(size=2)
    field = operator.field(given, plane=plane).samples
    other = field * random_image(draw, field.shape)
    return apart(field, other, given, operator.field_adjoint(other, plane=plane)), 1e-5


@relation(Use.POINTS, method="stored spreads")
def stored(draw):
    """Spreads that are stored have the products of those that are computed."""
    points, options = [draw.point(), draw.point()], {"wavelength": draw.wavelength, "accuracy": 0.0}
    weights, image = draw.rng.normal(size=2), draw.rng.random(draw.camera.shape)
    one, other = (kind(draw.camera, points, **options) for kind in (mp.CaptureOperator, mp.StoredOperator))
    return max(off(other.forward(weights), one.forward(weights)), off(other.adjoint(image), one.adjoint(image))), 5e-5


@relation(Use.POINT_RAYS | Use.RAY_SPREADS, "main_lens", "fits of points by rays")
def rays_of_points(draw):
    """The rays that fits follow are those of point spreads."""
    point = draw.point()
    rays = PointRays(draw.camera, np.array([point]), draw.wavelength)
    image = rays.image(OpticalSystem(draw.camera, draw.wavelength), np.ones(1))
    expected = mp.point_spread_function(draw.camera, point, model="ray", wavelength=draw.wavelength)
    if expected.sum() < 0.1:
        # Of a crop beside the light, or at its edge, the fraction of all light is compared.
        return abs(float(image.sum() - expected.sum())), 0.01
    return off(DetectorOperator.of(draw.camera).forward(image.astype(np.float32)), expected), 0.05


@relation(Use.RESPONSES, "vignetting mla_focal_length", "deconvolved")
def responses(draw):
    """Responses by waves and, but behind real lenses, by rays have the adjoint that is their transpose."""
    wavelength = draw.wavelength if "main_lens" in draw.options or draw.rng.random() < 0.5 else None
    response = Response(draw.camera, [draw.point()[2]], wavelength=wavelength, oversample=1)
    x, y = random_image(draw, response.source_shape), random_image(draw, draw.camera.shape)
    return apart(response.forward(x), y, x, response.adjoint(y)), 1e-5


FUNCTIONS = {
    "ray": (RayRefocus, Use.RAY_REFOCUSING | Use.RAY_DERIVATIVES, lambda w: (
        {}, {"footprint": "point", "oversample": 2}
    )),
    "partial": (CoherentRefocus, Use.FIELDS | Use.FIELD_DERIVATIVES, lambda w: (
        {"wavelength": w, "interleave": 1}, {"wavelength": w, "interleave": 2, "oversample": 2}
    )),
    "deconvolved": (DeconvolvedRefocus, Use.RESPONSES, lambda w: (
        {"iterations": 2}, {"iterations": 2, "wavelength": w}
    )),
}  # fmt: skip
"""Classes, what they need, and their options at a wavelength: by rays there is none."""


def of_functions(method, make, use, options):
    """Add the relation of refocusing by one method as a differentiable function."""

    def function(draw):
        """It gives the image of `reconstruct`, its derivative is a difference, and has a transpose."""
        g, image, worst = draw.point()[2], random_image(draw, draw.camera.shape), []
        for chosen in options(draw.wavelength):
            refocus = make(draw.camera, g, **chosen)
            if method == "deconvolved":
                chosen = chosen | {"accelerate": False, "response": "wave" if "wavelength" in chosen else "ray"}
            expected = mp.reconstruct(image, g, camera=draw.camera, method=method, **chosen).image
            change, step = image * (random_image(draw, image.shape) - 1), 2e-2
            if method == "ray":
                made, moved, back = refocus.forward(image), refocus.forward(change), refocus.adjoint
            else:
                at = refocus.at(image)
                made, moved, back = at.image, at.jvp(change), at.vjp
            y = random_image(draw, made.shape) - 1
            one, other = (refocus.forward(image + side * step * change).astype(float) for side in (1, -1))
            worst += [
                off(made, np.nan_to_num(np.squeeze(expected))) / 1e-4,
                off(moved, (one - other) / (2 * step)) / 5e-3,
            ]
            worst.append(apart(moved, y, change, back(y)) / 1e-5)
        return max(worst), 1.0

    function.__name__ = f"function_{method}"
    # Other functions know of lenses under chief rays the nearest regular array.
    without = "mla_focal_length main_lens" if method == "deconvolved" else "mla_cra"
    relation(use | Use.RECONSTRUCTION_DERIVATIVES, without, f"derivatives of {method}")(function)


for each, given in FUNCTIONS.items():
    of_functions(each, *given)
