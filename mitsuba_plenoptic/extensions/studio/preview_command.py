"""``mitsuba-plenoptic preview``: a quick view of a scene as the camera will see it."""

from pathlib import Path
from typing import Annotated

import typer

from ... import choices
from ...cli import inputs, options
from ...errors import InputError
from ...runtime import in_words, progress_bar


def preview(
    scene: options.Scene,
    *,
    output: Annotated[Path, options.ends_in(".png", ".pdf")] | None = None,
    camera: options.CameraFile | None = None,
    dpi: options.Dpi | None = None,
    unit: choices.Unit = "mm",
    waves: bool = False,
    spp: options.Count | None = None,
    variant: options.Variant | None = None,
    define: options.Definitions = None,
) -> None:
    """See in seconds what a camera will see of a scene, before it is captured.

    The picture is made by Mitsuba's thin lens with the camera's aperture, field and plane in focus, or by a microscope
    without its microlenses, in colour if the film records colours. What refocusing makes sharp is outlined in blue,
    what is in focus is tinted yellow. The command prints the field, the micro-images, faults of the framing, and the
    time of a ray capture, with --waves of a wave capture.

    Parameters
    ----------
    output : FILE
        Picture to write, .png or .pdf. Default: SCENE.preview.png.
    waves
        Estimate what a wave capture takes, too, which may take a while.

    Examples
    --------
    $ mitsuba-plenoptic preview letters
    $ mitsuba-plenoptic preview my_scene.xml --camera lytro
    $ mitsuba-plenoptic preview beads
    """
    from ...runtime import require_writable

    target = require_writable(output or Path(f"{Path(scene).stem}.preview.png"))
    inputs.require_png(dpi, target)
    costs: list[str] = []
    with progress_bar("Previewing") as progress:
        from ... import design
        from ...camera import PlenopticCamera
        from ...optics import guards
        from ...scene import estimate_capture, plenoptic_sensor

        loaded = inputs.open_scene(scene, inputs.parse_definitions(define), variant, camera, unit=unit)
        seen_by = PlenopticCamera.from_sensor(plenoptic_sensor(loaded))
        progress(1, 5)
        # Brings Matplotlib, which takes a while to load.
        from .preview import framing_warnings, preview_figure, preview_of

        shown_preview = preview_of(loaded, seen_by)
        progress(2, 5)
        view = shown_preview.view
        where = f"at {view.in_units(view.focus)}" if seen_by.objective is None else "in the native object plane"
        preview_figure(Path(scene).name, shown_preview).save(target, dpi)
        for model in ("ray", "wave") if waves else ("ray",):
            progress(3 + len(costs), 5)
            try:
                cost = estimate_capture(loaded, model=model, spp=spp)
                costs.append(f"{model} capture: about {in_words(cost.seconds)} and {cost.memory / 2**30:.2g} GiB")
            except (InputError, guards.PhysicsError) as error:
                costs.append(f"{model} capture: refused: {error}")
    typer.echo(f"{target}: the picture")
    typer.echo(f"field: {view.field_in_units()} {where}")
    typer.echo(f"{view.sharp_label}: {view.between(*view.sharp_range())}")
    pixels = seen_by.micro_image_pitch / seen_by.pixel_size
    count = f"{seen_by.lens_count[0]} x {seen_by.lens_count[1]}"
    if seen_by.objective is not None and seen_by.objective.is_fourier:
        count = str(len(design.lenses_in_stop(seen_by)[1]))
    typer.echo(f"micro-images: {pixels:.3g} pixels apart, {count} of them")
    for text in costs:
        typer.echo(text)
    for text in framing_warnings(shown_preview):
        typer.echo(f"framing: {text}")
