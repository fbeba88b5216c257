"""Each verdict of the report comes out both ways, by numbers that are made up."""

from types import SimpleNamespace

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.extensions.paper.claims import check_claims

FAIR = {"coherent": (0.08, 0.05), "partial": (0.009, 0.008), "seconds": (9.0, 1.0, 3.5), "mesh": (0.3, 0.01)}

READINGS = {
    "quarters": (0.009, 0.009),
    "sublattice": (0.009, 0.009),
    "colours": (4, 3),
    "literal_coherent": (0.08, 0.05),
    "literal_partial": (0.02, 0.02),
    "coherent_from_rays": (0.08, 0.05),
    "limit_from_rays": (0.01, 0.015),
}


def verdicts(coherent, partial, seconds, mesh, **readings):
    """Verdicts by statement; `mesh` is how far coherent and partial images are from that by rays, at each distance."""
    camera = PlenopticCamera(detector_width=2.048, resolution=(1024, 1024))
    ray = np.add.outer(np.arange(32.0), np.arange(32.0)) / 62
    noise = np.random.default_rng(0).normal(0, 1, ray.shape)
    images = {}
    for distance, shares in zip((210.0, 280.0), np.broadcast_to(mesh, (2, 2)), strict=True):
        images["ray", distance] = ray
        for method, share in zip(("coherent", "partial"), shares, strict=True):
            images[method, distance] = ray + share * noise
    interference = [
        {"shape": shape, "shape_distance": own, "distance": other, "coherent": a, "partial": b}
        for shape, own, other, a, b in zip(
            ("near", "far"), (210.0, 280.0), (280.0, 210.0), coherent, partial, strict=True
        )
    ]
    experiment = SimpleNamespace(settings=SimpleNamespace(distances=(210.0, 280.0)), images=images, camera=camera)
    read = {**READINGS, **readings}
    numbers = {
        "reconstructions": [{"bins": [32, 32]}],
        "interference": interference,
        "readings": [
            {"shape": shape, "distance": distance, **{name: pair[k] for name, pair in read.items()}}
            for k, (shape, distance) in enumerate((("near", 280.0), ("far", 210.0)))
        ],
    }
    named = dict(zip(("ray", "coherent", "partial"), seconds, strict=True))
    return {
        claim.statement.split(":")[0]: claim.verdict
        for claim in check_claims(experiment, numbers, named, "near", "far")
    }


@pytest.mark.parametrize(
    ("statement", "partly", "differs"),
    [
        ("Coherent propagation shows", [{"coherent": (0.08, 0.01)}], [{"coherent": (0.01, 0.01)}]),
        ("Partially coherent propagation strongly", [{"partial": (0.009, 0.04)}], [{"partial": (0.08, 0.05)}]),
        (
            "The partially coherent image",
            [{"mesh": ((0.3, 0.01), (0.01, 0.01))}],
            # As near as before, but no nearer than the coherent one; near on average, but not in what it shows.
            [{"mesh": (0.01, 0.01)}, {"mesh": (0.9, 0.3)}, {"mesh": (0.1, 0.03)}],
        ),
        ("Apart from interference", [{"limit_from_rays": (0.01, 0.03)}], [{"limit_from_rays": (0.03, 0.03)}]),
        *(
            # Where nothing is visible nothing is removed.
            (statement, [{name: (0.015, 0.009)}], [{name: (0.015, 0.015)}, {"coherent": (0.01, 0.01)}])
            for statement, name in (
                ("Four propagations, every second lens", "partial"),
                ("Four propagations, one for each quarter", "quarters"),
                ("Four propagations, of the four regular", "sublattice"),
            )
        ),
        ("With four propagations the images", [{"colours": (5, 4)}], [{"colours": (188, 144)}]),
        (
            "With a phase at the detector",
            [{"literal_coherent": (0.08, 0.03)}],
            [{"literal_coherent": (0.01, 0.01), "literal_partial": (0, 0)}, {"literal_partial": (0.05, 0.05)}],
        ),
        ("Reconstruction by waves is faster", [], [{"seconds": (0.1, 1.0, 3.5)}]),
        ("Partially coherent propagation takes", [], [{"seconds": (9.0, 1.0, 1.5)}, {"seconds": (9.0, 1.0, 5.0)}]),
    ],
)
def test_verdicts_come_out_each_way(statement, partly, differs):
    for verdict, changes in (("confirmed", [{}]), ("partly", partly), ("differs", differs)):
        for change in changes:
            found = verdicts(**{**FAIR, **change})
            assert next(found[name] for name in found if name.startswith(statement)) == verdict, change
