"""On-chip-lens cameras: pictures of dual and quad pixels, their disparity, and banks of their point spreads.

Such a camera is a `PlenopticCamera` whose microlenses cover 2 x 2 square pixels each. A photodiode is one of these
pixels, or a row or a column of two.
"""

from .disparity import bank_disparity, half_disparity, match_halves
from .halves import dual_pixel
from .spread_bank import psf_bank

__all__ = ["bank_disparity", "dual_pixel", "half_disparity", "match_halves", "psf_bank"]
