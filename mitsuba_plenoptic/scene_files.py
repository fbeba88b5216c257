"""The scenes that come with the package, by name."""

from pathlib import Path

from .errors import InputError, did_you_mean
from .presets import PRESETS


def scene_names() -> list[str]:
    """Return the names of the scenes that come with the package."""
    return sorted(path.stem for path in _folder().glob("*.xml"))


def _folder() -> Path:
    """Return the folder of the built-in scenes: in the installed package, or at the top of a clone."""
    installed = Path(__file__).with_name("scenes")
    return installed if installed.is_dir() else installed.parents[1] / "scenes"


def scene_path(name: str) -> Path:
    """Return the path of a scene that comes with the package.

    Parameters
    ----------
    name : str
        Name without suffix, such as ``letters``.
    """
    path = _folder() / f"{name}.xml"
    if path.name != f"{name}.xml" or not path.is_file():
        names = scene_names()
        fault = "is a camera: give it as --camera of a scene" if name in PRESETS else "is no file"
        raise InputError(
            f"scene = {name!r}: it {'is a folder' if Path(name).is_dir() else fault}; built-in scenes are "
            f"{', '.join(names)}{did_you_mean(name, names)}"
        )
    return path
