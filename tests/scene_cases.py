"""What tests of scenes share: the letters at any size, films, and pictures by a pinhole to compare with."""

import math

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import scene_path

_SCENE = """<scene version="3.0.0">
<integrator type="path"/>
<sensor type="plenoptic">
{sensor}
<film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="64"/>
<rfilter type="{rfilter}"/><string name="pixel_format" value="{pixel_format}"/>
<string name="component_format" value="float32"/></film>
</sensor>
{text}
</scene>"""

BUILT_IN = [
    pytest.param(name, marks=pytest.mark.needs_extension("laser")) if name == "speckle" else name
    for name in sorted(path.stem for path in scene_path("letters").parent.glob("*.xml"))
]
"""Names of the built-in scenes, one of which has a laser."""

SMALL_SENSOR = '<float name="detector_width" value="0.128"/>'
"""Two lenses across, for scenes that are rendered."""


def write_scene(folder, text='<emitter type="constant"/>', *, sensor="", rfilter="box", pixel_format="luminance"):
    """Write a scene file with these texts in its sensor and behind it, and return its path."""
    path = folder / "scene.xml"
    path.write_text(_SCENE.format(text=text, sensor=sensor, rfilter=rfilter, pixel_format=pixel_format))
    return path


def letters(lenses, **parameters):
    """Return the parameters that show the letters, as large in the picture as the paper's, on so many lenses across."""
    small = {"resolution": 32 * lenses, "detector_width": 0.064 * lenses, "letter_scale": lenses / 128}
    return {name: str(value) for name, value in (small | parameters).items()}


def definitions(parameters):
    """Return the words by which the command is given parameters of a scene."""
    return [word for name, value in parameters.items() for word in ("-D", f"{name}={value}")]


def film(columns, rows):
    """Describe a film of luminance that keeps every pixel to itself."""
    return {
        "type": "hdrfilm",
        "width": columns,
        "height": rows,
        "rfilter": {"type": "box"},
        "pixel_format": "luminance",
        "component_format": "float32",
    }


def disk(position, radius):
    """Describe a radiating disk that faces the camera."""
    return {
        "type": "disk",
        "to_world": mi.ScalarTransform4f().translate(position).rotate([0, 1, 0], 180).scale(radius),
        "emitter": {"type": "area", "radiance": 1.0},
    }


def pinhole_picture(scene, columns, rows, width, x=0.0, y=0.0, **options):
    """Render what a point (x, y) of the main lens sees of the plane at 240 mm, whose image is of this width."""
    sensor = {
        "type": "perspective",
        "fov": math.degrees(2 * math.atan(width / 240)),
        # The film's middle stays where the plane in focus meets the axis.
        "principal_point_offset_x": x * 120 / 240 / width,
        "principal_point_offset_y": y * 120 / 240 / width,
        "to_world": mi.ScalarTransform4f().translate([x, y, 0]),
        "film": film(columns, rows),
    }
    return np.array(mi.render(scene, sensor=mi.load_dict(sensor), **options))


def colour_filters(camera, mosaic):
    """Return each pixel's channel: the letters of a mosaic's name, row by row from the detector's first pixel."""
    columns, rows = (
        (np.arange(count) + first) % 2 for first, count in zip(camera.crop_offset, camera.crop_size, strict=True)
    )
    return np.array(["RGB".index(letter) for letter in mosaic]).reshape(2, 2)[np.ix_(rows, columns)]
