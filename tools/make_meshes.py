"""Write the meshes and textures of the built-in scenes.

Usage: ``python tools/make_meshes.py [-o DIRECTORY]``; without a directory, the files in ``scenes/`` are
replaced.

Everything is defined by the geometry in ``tools/built_in_scenes`` and comes out the same, byte for byte, wherever it
runs: coordinates are rounded to a nanometre before they become float32, and textures are stored without compression,
because compressors differ between builds of zlib.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from built_in_scenes.figures import chart_bars, letter_eight, letter_f, letter_hash, siemens_star, slanted_square
from built_in_scenes.images import write_hdr, write_png
from built_in_scenes.mesh import flat_mesh
from built_in_scenes.solids import fibres, pawn, rounded_die, solid_lambda, torus_knot
from built_in_scenes.textures import (
    average,
    die,
    leaf,
    leaf_mask,
    levels,
    ramp,
    stripes,
    surroundings,
    tiles,
    waves,
    wood,
)

SCENES = Path(__file__).resolve().parent.parent / "scenes"


def write_all(directory: Path) -> list[Path]:
    """Write every mesh and texture below a directory and return the paths."""
    meshes = {
        "eight": flat_mesh(letter_eight()),
        "f": flat_mesh(letter_f()),
        "hash": flat_mesh(letter_hash()),
        "star": flat_mesh(siemens_star(24, 0.1, 2.0, 6)),
        "bars": flat_mesh(chart_bars()),
        "edge": flat_mesh(slanted_square(3.0, 5.0)),
        "pawn": pawn(),
        "die": rounded_die(3.4, 0.42, 4),
        "knot": torus_knot(2.3, 0.42, 128, 20),
        "lambda": solid_lambda(4.2, 1.0),
        "fibres": fibres(),
    }
    textures = {
        "waves": (levels(waves, 256, 256), ramp((54, 88, 138), (240, 234, 216))),
        "wood": (levels(wood, 384, 384), ramp((72, 42, 26), (238, 194, 138))),
        "die": (levels(die, 192, 288), ramp((26, 20, 24), (240, 236, 226))),
        "stripes": (levels(stripes, 128, 256), ramp((164, 38, 34), (242, 230, 208))),
        "tiles": (levels(tiles, 256, 256), ramp((38, 34, 36), (236, 226, 208))),
        "leaf": (levels(leaf, 192, 128), ramp((30, 74, 22), (190, 214, 96))),
        "leaf_mask": (levels(leaf_mask, 192, 128), ramp((0, 0, 0), (255, 255, 255))),
    }
    folder = directory / "meshes"
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, mesh in meshes.items():
        paths.append(folder / f"{name}.ply")
        mesh.write_ply(paths[-1])
    for name, picture in textures.items():
        paths.append(directory / f"{name}.png")
        write_png(paths[-1], *picture)
    paths.append(directory / "surroundings.hdr")
    write_hdr(paths[-1], average(surroundings, 64, 128))
    return paths


def main() -> None:
    """Write the files and say what was written."""
    parser = argparse.ArgumentParser(description="Write the meshes and textures of the built-in scenes.")
    parser.add_argument("-o", "--output", type=Path, default=SCENES, help="the folder (default: scenes/)")
    for path in write_all(parser.parse_args().output):
        print(f"{path}  {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
