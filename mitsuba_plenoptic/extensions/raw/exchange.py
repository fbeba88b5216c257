"""Light-field files: NetCDF and Zarr, and formats of other programs: LFToolbox, mosaics and plain raw pictures."""

from ...io import read_labelled_data, read_picture
from ...views import (
    open_light_field,
    open_micro_images,
    read_labelled,
    read_mosaic,
    save_light_field,
    write_labelled,
    write_mosaic,
)
from .lftoolbox import read_lftoolbox, write_lftoolbox
from .lytro_file import nearest_white, read_lytro

__all__ = [
    "nearest_white",
    "open_light_field",
    "open_micro_images",
    "read_labelled",
    "read_labelled_data",
    "read_lftoolbox",
    "read_lytro",
    "read_mosaic",
    "read_picture",
    "save_light_field",
    "write_labelled",
    "write_lftoolbox",
    "write_mosaic",
]
