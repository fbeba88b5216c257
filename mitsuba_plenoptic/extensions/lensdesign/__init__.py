"""Extension `lensdesign`: lens files of Zemax and CODE V, and focusing by moving a group of a lens's elements."""

from ...extension import Extension, FileFormat

EXTENSION = Extension(
    formats={".zmx": FileFormat("lens", "zemax_file:read_zemax"), ".seq": FileFormat("lens", "codev_file:read_codev")}
)
