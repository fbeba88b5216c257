"""Panels of pictures for the notebooks: widgets where a kernel runs, plain HTML with the same sliders on the site."""

from __future__ import annotations

import base64
import io
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

_WIDTH = 480


@dataclass(frozen=True)
class Panel:
    """Pictures, of which sliders choose the one that is shown.

    Parameters
    ----------
    names : sequence of str
        What each slider is called.
    labels : sequence of sequences of str
        What its positions are called.
    pictures : sequence of bytes
        A PNG for each combination of positions, the last slider's changing fastest.
    """

    names: Sequence[str]
    labels: Sequence[Sequence[str]]
    pictures: Sequence[bytes]

    def widget(self) -> Any:
        """Return an ipywidgets box, which works without a kernel, too."""
        import ipywidgets

        shapes = [len(labels) for labels in self.labels]
        shown = ipywidgets.Image(value=self.pictures[0], format="png", width=_WIDTH)
        sliders = [
            ipywidgets.SelectionSlider(options=list(zip(labels, range(len(labels)), strict=True)), description=name)
            for name, labels in zip(self.names, self.labels, strict=True)
        ]

        def show(_: Any) -> None:
            index = np.ravel_multi_index([slider.value for slider in sliders], shapes)
            shown.value = self.pictures[int(index)]

        for slider in sliders:
            slider.observe(show, "value")
        return ipywidgets.VBox([*sliders, shown])

    def html(self) -> str:
        """Return HTML that needs neither a kernel nor a network."""
        images = "".join(
            f'<img alt="{" ".join(words)}" src="data:image/png;base64,{base64.b64encode(picture).decode()}"'
            f"{' hidden' if number else ''}>"
            for number, (words, picture) in enumerate(zip(itertools.product(*self.labels), self.pictures, strict=True))
        )
        move = (
            "const p=this.closest('.mp-panel');let i=0;"
            "p.querySelectorAll('input').forEach(s=>{i=i*(+s.max+1)+ +s.value;"
            "s.parentNode.querySelector('output').value=JSON.parse(s.dataset.labels)[s.value]});"
            "p.querySelectorAll('img').forEach((m,n)=>m.hidden=n!==i)"
        )
        sliders = "".join(
            f"<label>{name}: <output>{labels[0]}</output>"
            f'<input type="range" min="0" max="{len(labels) - 1}" value="0" aria-label="{name}"'
            f" data-labels='{_json(labels)}' oninput=\"{move}\"></label>"
            for name, labels in zip(self.names, self.labels, strict=True)
        )
        return f'<div class="mp-panel">{sliders}{images}</div>'

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        return {"text/html": self.html(), "text/plain": repr(self.names), **self.widget()._repr_mimebundle_()}


def _json(labels: Sequence[str]) -> str:
    return "[" + ",".join(f'"{label}"' for label in labels) + "]"


def png(image: np.ndarray, white: float, width: int = _WIDTH) -> bytes:
    """Return an image of radiance as an sRGB picture, each pixel enlarged to a square."""
    level = np.clip(np.nan_to_num(np.asarray(image, float)) / white, 0, 1) ** (1 / 2.2)
    factor = max(1, width // level.shape[1])
    pixels = np.kron((255 * level + 0.5).astype(np.uint8), np.ones((factor, factor), np.uint8))
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", optimize=True)
    return stream.getvalue()


def refocus_slider(results: Sequence[Any]) -> Panel:
    """Show reconstructions, which share one scale, under a slider of their distances."""
    white = max(float(np.nanpercentile(result.image, 99.5)) for result in results)
    labels = [f"{result.distance:g} mm" for result in results]
    return Panel(["distance"], [labels], [png(np.squeeze(result.image), white) for result in results])


def micro_image_inspector(capture: Any, columns: range, rows: range) -> Panel:
    """Show the micro-images of some lenses of an upright square lattice, each with its place, under two sliders."""
    image, camera = np.squeeze(capture.image), capture.camera
    white = float(np.percentile(image, 99.5))
    pitch, half = camera.micro_image_pitch / camera.pixel_size, int(camera.pixels_per_lens / 2)

    def cut(row: int, column: int) -> np.ndarray:
        middle = [(count - 1) / 2 for count in reversed(camera.lens_count)]
        centre = [
            round((size - 1) / 2 + (index - m) * pitch)
            for size, index, m in zip(image.shape, (row, column), middle, strict=True)
        ]
        top, left = (max(0, place - half) for place in centre)
        return image[top : top + 2 * half, left : left + 2 * half]

    pictures = [png(cut(row, column), white, 256) for row in rows for column in columns]
    return Panel(["row", "column"], [[str(i) for i in rows], [str(i) for i in columns]], pictures)
