"""Write a small picture of a capture: ``python tools/capture_picture.py raw.exr raw.png``."""

from __future__ import annotations

import sys

from mitsuba_plenoptic import read_capture
from mitsuba_plenoptic.report.images import shrink, write_png

# Wide enough that the micro-images of 128 lenses remain discernible.
LONGEST_SIDE = 1024

if __name__ == "__main__":
    source, target = sys.argv[1:]
    write_png(target, shrink(read_capture(source).image, LONGEST_SIDE))
