"""Light fields and captures of other programs: LFToolbox files, mosaics of views or lenses, plain raw pictures."""

from .files import open_light_field, save_light_field
from .lftoolbox import read_lftoolbox, write_lftoolbox
from .mosaic import LAYOUTS, read_mosaic, write_mosaic
from .pictures import read_picture

__all__ = [
    "LAYOUTS",
    "open_light_field",
    "read_lftoolbox",
    "read_mosaic",
    "read_picture",
    "save_light_field",
    "write_lftoolbox",
    "write_mosaic",
]
