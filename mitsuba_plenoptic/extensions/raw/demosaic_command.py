"""``mitsuba-plenoptic demosaic``: three colours of every pixel of a raw picture."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from ... import choices
from ...cli import inputs, options
from ...errors import refuse_if
from ...runtime import progress_bar


def demosaic(
    capture: options.CaptureFile,
    *,
    output: Annotated[Path, options.ends_in(".exr")],
    mosaic: choices.Mosaic | None = None,
    white: Path | None = None,
    camera: options.CameraFile | None = None,
    linear: bool = False,
    black_level: float = 0,
) -> None:
    """Estimate all three colours of every pixel, micro-image by micro-image.

    Only pixels of the same micro-image are used. A raw picture (.png or .tiff) that 'expose' wrote holds all that is
    needed, and so do raw pictures of Lytro cameras (.lfp or .lfr); for another real camera give its
    [bold]--camera[/bold]. White pictures of a Lytro camera also correct pitches, rotation and offset of its lenses.

    Parameters
    ----------
    output : FILE.exr
        File to write.
    mosaic
        Colour filters of the first pixels of two rows. Default: as the capture states.
    white : FILE|FOLDER
        A capture or picture of a white scene by the same camera, without a mosaic; for a raw picture of a Lytro
        camera its white picture, or a folder of them, of which the nearest in zoom and focus is taken. Default:
        computed from the camera.
    black_level
        Number without light in a raw picture, in its own numbers; needs --camera and --linear.

    Examples
    --------
    $ mitsuba-plenoptic demosaic bayer.exr -o colours.exr
    $ mitsuba-plenoptic demosaic bayer.tiff -o colours.exr
    $ mitsuba-plenoptic demosaic raw.tiff -o colours.exr --mosaic GRBG --camera lytro --linear
    $ mitsuba-plenoptic demosaic photo.lfr -o colours.exr --white white_pictures
    """
    from ...io import mosaic_of, read_capture, write_capture
    from ...runtime import require_output
    from .lytro_file import nearest_white

    require_output(output, capture, white)
    # Brings libraries that take a while to load.
    from .demosaic import balanced
    from .demosaic import demosaic as interpolate

    inputs.require_linear(linear, capture, white)
    camera_of_option = inputs.named_camera(camera)
    refuse_if(
        black_level and not (linear and camera_of_option),
        f"--black-level {black_level:g}: it is for raw pictures with --linear and --camera",
    )
    recorded = read_capture(capture, camera=camera_of_option, linear=linear, black_level=black_level)
    reference = None
    if white is not None:
        if white.is_dir():
            white = nearest_white(white, recorded)
            typer.echo(f"{white}: the white picture of the nearest zoom and focus")
        reference = read_capture(white, camera=camera_of_option, linear=linear)
        if (tile := mosaic_of(reference)) is not None:
            camera_seen = recorded.camera
            if camera_of_option is None:
                # Brings libraries that take a while to load.
                from ..inverse.fitting import lattice_from_white

                camera_seen = lattice_from_white(camera_seen, balanced(reference, tile))
            recorded = replace(recorded, camera=camera_seen)
            reference = interpolate(replace(reference, camera=camera_seen))
    with progress_bar("Demosaicking") as progress:
        result = interpolate(recorded, mosaic=mosaic, white=reference, progress=progress)
    write_capture(output, result)
    typer.echo(f"{output}: {result.camera.shape[1]} x {result.camera.shape[0]} pixels of three colours")
