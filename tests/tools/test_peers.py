"""The comparison with other packages, without any of them."""

import itertools
import math

import numpy as np
from cases import relative

from mitsuba_plenoptic import PlenopticCamera, decode
from mitsuba_plenoptic.views import lens_grid, shift_and_add, white_image
from tools.bench import registry, tables
from tools.bench.cases import peers
from tools.bench.cases.peers import published_decode, published_refocus
from tools.bench.timing import Timing


def test_a_peer_that_is_missing_or_fails_gives_one_line_and_the_others_are_compared(monkeypatch):
    seconds = itertools.cycle([1.0, 3.0, 1.0, 2.0, 1.0, 4.0])
    monkeypatch.setattr(peers, "paired", lambda works, repeats, warm: timings(works, seconds))

    def missing():
        raise ImportError("no", name="no_such_package")

    def failing():
        raise RuntimeError("does not start\nat all")

    def present():
        return peers.Peer(lambda: None, {"difference": 1e-7}, "as it advises")

    makers = {"absent": missing, "broken": failing, "there": present}
    rows = list(peers.against("work", {"ours": lambda: None}, makers, 1))
    table = tables.markdown({"peer": "{peer}", **peers.TIMES}, rows).splitlines()
    assert table[2] == "| absent |  |  |  | not installed (no_such_package) |"
    assert table[3] == "| broken |  |  |  | fails: does not start |"
    assert table[4] == "| there | 1e+03 | 3e+03 | 3 (2 to 4) | as it advises |"


def timings(works, seconds):
    found = [next(seconds) for _ in works]
    return {
        name: Timing(value, value, value / found[0], value / found[0]) for name, value in zip(works, found, strict=True)
    }


def test_our_microlenses_are_the_closed_form():
    (row,) = (row for row in peers._microlenses(256, 2.048 / 256, 1) if row["peer"] == "ours")
    assert row["difference"] < 1e-6
    assert registry.find(["peers.microlenses"])[0].verdict({**row, "difference": 1e-4}).startswith("FAILED")


def test_the_published_algorithm_decodes_and_refocuses_as_ours_does():
    camera = PlenopticCamera(detector_width=1.024, resolution=(512, 512))
    x = (np.arange(512) + 0.5) / 512
    white, grid = white_image(camera), lens_grid(camera)
    image = (white * (2 + np.sin(4 * math.pi * x) * np.cos(3 * math.pi * x[:, None]))).astype(np.float32)
    lf = decode(image, camera=camera, white=white)
    light, known, step = published_decode(image, white, grid, lf.sizes["u"] / 2)
    middle = len(light) // 2
    centre = (lf.sizes["v"] // 2, lf.sizes["u"] // 2)
    assert relative(light[middle, middle] / known[middle, middle], lf.values[centre]) < 0.02
    for shift in (0.0, 0.06, -0.06):
        mine, published = shift_and_add(lf, shift).values, published_refocus(light, known, shift * step)
        assert relative(published[2:-2, 2:-2], mine[2:-2, 2:-2]) < 0.02
    # A shift of the wrong sign is seen.
    assert relative(published_refocus(light, known, 0.06 * step)[2:-2, 2:-2], mine[2:-2, 2:-2]) > 0.02
