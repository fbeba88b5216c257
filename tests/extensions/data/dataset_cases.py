"""Small recipes."""

import copy

SMALL = {
    "name": "small",
    "count": 5,
    "seed": 3,
    "models": ["ray"],
    "camera": {"detector_width": 0.256, "resolution": [64, 64], "focus_distance": {"from": 230, "to": 250}},
    "scenes": [
        {"generator": "shapes", "objects": {"from": 3, "to": 6, "step": 1}},
        {"scene": "white", "parameters": {"resolution": 64, "detector_width": 2.048}},
    ],
    "light": {"sky": {"from": 0.2, "to": 0.6}},
    "noise": {"photons": {"from": 300, "to": 3000, "scale": "log"}},
    "ray": {"spp": 2},
    "samples_per_shard": 2,
}


def small(**changes):
    return {name: value for name, value in {**copy.deepcopy(SMALL), **changes}.items() if value is not None}
