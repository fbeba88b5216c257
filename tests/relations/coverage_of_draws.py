"""What draws of relations have computed: relations, options, pairs of options, methods and formats."""

import itertools
import json
import os
from collections import Counter
from functools import cache
from pathlib import Path

from camera_draws import OPTIONS, possible
from of_files import FORMATS
from relation import RELATIONS, supported

from mitsuba_plenoptic.camera import with_gradient
from mitsuba_plenoptic.camera.entry import Captures, Use

ENOUGH = 5
"""Times that each is computed in a long hunt."""

WITHOUT_LIGHT = {"files", "files of captures", "mosaics of colours", "far sources", "dual pixels", "particles"}
"""Methods that compute next to nothing of a camera's options, so that they count for no pair of them."""

OF_SLOPES = {"derivative", "product_rule"}
"""Relations of derivatives by parameters, of which each is asked beside each option."""


@cache
def allowed_pairs():
    """Return the pairs of options that a camera may have and some relation speaks of."""
    spoken = [set(OPTIONS) - relation.without for relation in RELATIONS.values()]
    return [
        f"{one} {other}"
        for one, other in itertools.combinations(OPTIONS, 2)
        if any({one, other} <= options for options in spoken)
        and any(len(possible(seed, pair, Use(0)).options) == 2 for seed in (1, 2, 3) for pair in [(one, other)])
    ]


@cache
def allowed_slopes():
    """Return the pairs of a parameter with a derivative and an option beside which it has one."""
    options = supported(Use.POINT_DERIVATIVES)
    return [f"{name} {option}" for name in with_gradient(Captures.POINTS) for option in options]


class Tally:
    """Counts of draws by what they computed, added to those of the file that COUNTS names."""

    def __init__(self):
        self.path = Path(os.environ["COUNTS"]) if "COUNTS" in os.environ else None
        self.before, self.counts = self._stored(), self._stored()
        self.failures = 0

    def _stored(self):
        stored = json.loads(self.path.read_text()) if self.path and self.path.is_file() else {}
        return {kind: Counter(stored.get(kind)) for kind in ("verdict", "option", "pair", "slope", "method", "format")}

    def add(self, relation, outcome):
        """Count a draw of a relation; options, methods and formats where it was computed."""
        self.counts["verdict"][f"{relation.name} {outcome.verdict}"] += 1
        self.failures += outcome.verdict == "fails"
        if outcome.verdict == "computed":
            options = outcome.draw.options if relation.method not in WITHOUT_LIGHT else ()
            self.counts["option"].update(options)
            self.counts["pair"].update(" ".join(pair) for pair in itertools.combinations(options, 2))
            self.counts["slope"].update(f"{slope} {name}" for slope in outcome.draw.slopes for name in options)
            self.counts["method"][relation.method] += 1
            self.counts["format"].update(filter(None, [outcome.draw.format]))

    def times(self, relation, one, other):
        """Return how often two options were computed together, or either beside derivatives."""
        if relation.name not in OF_SLOPES:
            return self.counts["pair"][f"{one} {other}"]
        slopes = self.counts["slope"].items()
        return min(sum(n for key, n in slopes if key.endswith(f" {name}")) for name in (one, other))

    def wants(self, relation):
        """Return whether a relation computes what was computed less often than enough."""
        slopes = relation.name in OF_SLOPES and any(self.counts["slope"][each] < ENOUGH for each in allowed_slopes())
        return slopes or self.counts["method"][relation.method] < ENOUGH

    def report(self):
        """Print counts, what was computed less often than enough, and relations that skip most of their draws."""
        for name in RELATIONS:
            verdicts = {key.split()[1]: n for key, n in self.counts["verdict"].items() if key.split()[0] == name}
            skipped = sum(verdicts.values()) - verdicts.get("computed", 0) - verdicts.get("fails", 0)
            mark = " (skips most)" if skipped > max(ENOUGH, sum(verdicts.values()) / 2) else ""
            print(f"{name}: {', '.join(f'{n} {verdict}' for verdict, n in verdicts.items())}{mark}")
        asked = {
            "option": list(OPTIONS),
            "pair": allowed_pairs(),
            "slope": allowed_slopes(),
            "method": sorted({relation.method for relation in RELATIONS.values()}),
            "format": [f"{kind} {suffix}" for kind, suffixes in FORMATS.items() for suffix in suffixes],
        }
        for kind, names in asked.items():
            rare = [name for name in names if self.counts[kind][name] < ENOUGH]
            listed = ", ".join(rare[:20]) + (", ..." if len(rare) > 20 else "")
            print(f"{kind}: {len(names) - len(rare)} of {len(names)} computed {ENOUGH} times; less: {listed or 'none'}")
        if self.path:
            # Other hunts may have added theirs meanwhile.
            added = {kind: counts + self.counts[kind] - self.before[kind] for kind, counts in self._stored().items()}
            self.path.write_text(json.dumps(added))
