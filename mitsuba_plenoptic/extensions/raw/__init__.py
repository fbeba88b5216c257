"""Extension `raw`: raw pictures of Lytro cameras, mosaics of colour filters, and files of LFToolbox.

White pictures of mosaics need the extension `inverse`.
"""

from ...extension import Extension, FileFormat

EXTENSION = Extension(
    modules={"exchange": "exchange"},
    commands={"demosaic": "demosaic_command"},
    formats={
        **dict.fromkeys((".lfp", ".lfr", ".raw"), FileFormat("capture", "lytro_file:read_lytro")),
        "parameters.cfg": FileFormat("light field", "hci:read_hci", "hci:write_hci"),
        ".mat": FileFormat("light field", "lftoolbox:read_lftoolbox", "lftoolbox:write_lftoolbox"),
    },
)
