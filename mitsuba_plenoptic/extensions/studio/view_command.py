"""``mitsuba-plenoptic view``: an interactive page of a capture."""

from pathlib import Path
from typing import Annotated

import typer

from ...cli import inputs, options
from ...errors import refuse_if
from ...runtime import progress_bar


def view(
    sources: list[options.CaptureFile],
    *,
    output: Annotated[Path, options.ends_in(".html")] | None = None,
    white: options.Existing | None = None,
    view_count: int | None = None,
    linear: bool = False,
    camera: options.CameraFile | None = None,
) -> None:
    """Make a page to look at a capture: viewpoint, focus, micro-images.

    The page is one HTML file that any browser opens from disk, without loading anything else. Drag to move the
    viewpoint, click to refocus. The page refocuses by rays, from views of the capture; given reconstructions and focal
    stacks are shown as computed.

    Parameters
    ----------
    sources : SOURCE
        One or two captures or light fields to be compared, and what was computed of them: focal stacks,
        reconstructions, a depth map.
    output : FILE.html
        File to write. Default: named as the first source.

    Examples
    --------
    $ mitsuba-plenoptic view raw.exr
    $ mitsuba-plenoptic view ray.exr wave.exr -o compare.html
    $ mitsuba-plenoptic view raw.exr out_210.exr out_240.exr out_280.exr depth.exr
    """
    from ...runtime import require_output
    from .viewer import Recording
    from .viewer import view as make_page
    from .viewer_sources import read_source

    refuse_if(not sources[0].name, f"{sources[0]}: it is not a regular file")
    target = output or sources[0].with_suffix(".html")
    require_output(target, *sources, white)
    camera_of_option = inputs.named_camera(camera)
    with progress_bar("Making the page"):
        reconstructions = [
            read_source(source, white=white, views=view_count, linear=linear, camera=camera_of_option)
            for source in sources
        ]
        has_recording = any(isinstance(item, Recording) for item in reconstructions)
        for name, value in {"white": white, "view-count": view_count, "camera": camera}.items():
            refuse_if(
                value is not None and not has_recording, f"--{name} {value}: of no use without a capture or light field"
            )
        make_page(*reconstructions).save(target)
    typer.echo(f"{target}: {target.stat().st_size / 2**20:.1f} MiB; open it in a browser")
