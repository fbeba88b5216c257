"""``mitsuba-plenoptic compare``: a scene by rays and by waves, refocused by every method."""

from typing import Annotated

import typer

from ..choices import Against, Unit
from ..errors import InputError, refuse_if, require_count
from ..extension import hook
from . import options
from .inputs import COLOURS, camera_instead, colours_of_film, named_camera, parse_definitions
from .stopping import stage_lines


def compare(
    scene: Annotated[str, options.SCENE] | None = None,
    *,
    output: options.OutputFolder,
    distance: options.Distances | None = None,
    wavelength: options.Wavelength | None = None,
    spp: options.Count = 16,
    methods: str = "ray,coherent,partial,incoherent,deconvolved",
    against: Against | None = None,
    real: options.Existing | None = None,
    white: options.Existing | None = None,
    dark: options.Existing | None = None,
    plane: list[options.Number] | None = None,
    part: str | None = None,
    resume: options.Resume = False,
    camera: options.CameraFile | None = None,
    unit: Unit = "mm",
    define: options.Definitions = None,
    variant: options.Variant | None = None,
) -> None:
    """Capture a scene by rays and by waves, refocus it by every method, and compare.

    Writes figures, captures, reconstructions and all results, with a report.html that shows them in a browser. Both
    captures have the same main lens, which the scene's lens_model states. A run that was stopped resumes where it was.

    Parameters
    ----------
    wavelength : NM
        Of waves: wavelength in nanometres. Default: 633; --real needs the one of its light.
    spp
        Samples per pixel, by rays and by waves.
    methods : NAME,...
        What both captures are refocused by, and rays; the last two take most of the time. A further one, limit,
        propagates one lens at a time, takes longest, and shows what interference between lenses adds. Of the Fourier
        arrangement of microscopes waves do not go back, and coherent and partial are left out.
    against
        Also show what the camera sees without its microlens array, in focus at the first distance, and the sharpness
        of both.
    real : LIGHTFIELD
        Light field of a real camera with a thin lens or an objective, instead of a scene: planes are found from part
        of its pixels, and predict the others, by rays and by waves. --camera is the camera as known.
    white : FILE
        With --real: picture of something evenly white.
    dark : FILE
        With --real: picture without light.
    plane : MM
        With --real: distance of a plane of the scene; repeat for several. Default: found by a search; all behind an
        objective.
    part : LEFT,TOP,RIGHT,BOTTOM
        With --real: part of the picture, such as 0.5,0.5,1,1. Default: the middle quarter.
    variant : NAME
        Mitsuba variant of one colour or in rgb, for example cuda_ad_mono. Default: llvm_ad_rgb if the film records
        rgb, else llvm_ad_mono.

    Examples
    --------
    $ mitsuba-plenoptic compare chart -o chart --distance 210 --distance 240
    $ mitsuba-plenoptic compare still_life -o still_life --distance 215
      --distance 258 -D resolution=2048 -D detector_width=4.096
    $ mitsuba-plenoptic compare my_scene.xml -o out --camera lytro --distance 300
    $ mitsuba-plenoptic compare --real leg.png --white white.png --dark dark.tif
      --camera lfm_water --wavelength 510 -o leg
    """
    if real is not None:
        refuse_if(scene is not None, f"scene = {scene}: --real takes its place")
        refuse_if(bool(distance or against or define), "--distance, --against, -D: they are not for --real")
        nominal = named_camera(camera)
        refuse_if(None in (white, nominal, wavelength), "--real: give --white, --camera and --wavelength, too")
        with stage_lines(resume) as stages:
            hook("--real", "--real")(
                real,
                output,
                nominal,
                white=white,
                dark=dark,
                wavelength=wavelength,
                part=part,
                planes=plane or [],
                options=stages,
            )
        return
    refuse_if(any((white, dark, plane, part)), "--white, --dark, --plane, --part: they are for --real")
    if scene is None or not distance:
        raise InputError("scene, --distance: give a scene and a distance, or --real with a real light field")
    from ..optics import RGB_WAVELENGTHS

    # Figures need libraries that take a second to load, which other commands need not wait for.
    from ..report import Settings, comparison, methods_of_both, metrics
    from ..runtime import DEFAULT_VARIANT
    from ..scene import MOST_SAMPLES

    parameters = parse_definitions(define)
    if variant is None:
        variant = COLOURS if colours_of_film(scene, parameters) else DEFAULT_VARIANT
    in_colour = "mono" not in variant
    refuse_if(
        in_colour and wavelength is not None,
        f"--wavelength = {wavelength}: a comparison in colour has three of its own; take --variant {DEFAULT_VARIANT}",
    )
    settings = Settings(
        scene=scene,
        unit=unit,
        distances=tuple(sorted(set(distance))),
        parameters=parameters,
        camera=camera_instead(camera, scene, parameters),
        camera_name=camera,
        wavelength=wavelength or (RGB_WAVELENGTHS[1] if in_colour else 633.0),
        methods=methods_of_both(methods.split(",")),
        spp=require_count("spp", spp, maximum=MOST_SAMPLES),
        noise=spp > 1,
        variant=variant,
    )
    with stage_lines(resume) as stages:
        results = comparison.compare(settings, output, stages=stages, against=against)
    captures = results["captures"]
    typer.echo(
        f"Rays against waves: {captures['psnr']:.1f} dB, SSIM {metrics.ssim_text(captures['ssim'])}, energy "
        f"{captures['energy']:.3f}"
    )
    if against is not None:
        halves = [f"{row['title']} {row['mtf50_per_mm']:.3g}" for row in results["ordinary"]["pictures"]]
        typer.echo(f"Half the contrast, in cycles per mm: {', '.join(halves)}")
    typer.echo(results["answer"])
    typer.echo(f"{output / 'report.html'}: open it in a browser")
