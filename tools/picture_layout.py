"""Layout of the documentation's pictures: sheets of titled images, colours of maps, pages in a browser."""

from __future__ import annotations

import io
import shutil
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from PIL import Image
from selenium import webdriver
from selenium.webdriver.support.wait import WebDriverWait

from mitsuba_plenoptic.report.images import Brightness, to_bytes
from mitsuba_plenoptic.report.plots import Plot, annotate

WIDTH, DPI, LARGEST = 7.5, 104, 150_000
"""Width of a picture in inches, its pixels per inch, and the size of its file in bytes."""

FLAGS = (
    "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking "
    "disable-component-update disable-sync hide-scrollbars"
)

Panel = tuple[str, np.ndarray]
"""A title, and an image of bytes or of radiances, which are drawn on the scale of their sheet."""


def sheet(
    rows: Sequence[Sequence[Panel]], white: float | None = None, colours: tuple[ScalarMappable, str] | None = None
) -> Image.Image:
    """Lay out images of one size with their titles; radiances share a scale.

    The colours of the last image are explained by a bar below it.
    """
    radiances = [image for row in rows for _, image in row if image.dtype != np.uint8]
    peak = white or (Brightness().peak(radiances) if radiances else 1.0)
    aspects = [max(image.shape[0] / image.shape[1] for _, image in row) for row in rows]
    plot = Plot(WIDTH, dpi=DPI)
    panels = plot.panels(len(rows), len(rows[0]), aspects)
    for line, row in zip(panels, rows, strict=True):
        for axes, (name, image) in zip(line, row, strict=False):
            shown = image if image.dtype == np.uint8 else to_bytes(image, peak)
            axes.imshow(shown, cmap="gray", vmin=0, vmax=255, interpolation="none", aspect="auto")
            annotate(axes, title=name, size=9)
    if colours:
        plot.colour_bar(colours[0], panels[-1, -1], colours[1], location="bottom")
    return drawn(plot)


def drawn(plot: Plot) -> Image.Image:
    """Return what a figure shows."""
    return Image.open(io.BytesIO(plot.png())).convert("RGB")


def write(path: Path, image: Image.Image) -> None:
    """Write a palette PNG with as many colours as its size allows."""
    for colours in (256, 128, 64, 32):
        stream = io.BytesIO()
        palette = image.quantize(colours, kmeans=1, dither=Image.Dither.NONE)
        palette.save(stream, "PNG", optimize=True)
        if stream.tell() <= LARGEST:
            break
    else:
        raise SystemExit(f"{path}: {stream.tell()} bytes with 32 colours; at most {LARGEST}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(stream.getvalue())
    size = f"{image.width} x {image.height}, {colours} colours, {stream.tell() / 1000:.0f} kB"
    print(f"{path.relative_to(path.parents[1])}: {size}", flush=True)


def coloured(
    values: np.ndarray, low: float, high: float, *, colours: str = "viridis", unknown: int = 217
) -> np.ndarray:
    """Return values as colours between two ends, and NaN as a grey."""
    shown = matplotlib.colormaps[colours](np.clip((values - low) / (high - low), 0, 1))
    return np.where(np.isnan(values)[..., None], unknown, 255 * shown[..., :3]).astype(np.uint8)


def in_browser(page: Path, width: int, height: int) -> Image.Image:
    """Take a picture of a page when it is complete, as Chromium shows it without a window."""
    options = webdriver.ChromeOptions()
    for flag in FLAGS.split():
        options.add_argument(f"--{flag}")
    # The installed driver: without its path, Selenium would look for one on the network.
    service = webdriver.ChromeService(shutil.which("chromedriver"))
    with webdriver.Chrome(options=options, service=service) as browser:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get(page.resolve().as_uri())
        WebDriverWait(browser, 60).until(lambda seen: not seen.find_elements("css selector", "[aria-busy]"))
        return Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")


def narrowed(image: Image.Image, width: int = 900) -> Image.Image:
    """Shrink a picture to a width."""
    return image.resize((width, round(width * image.height / image.width)), Image.Resampling.LANCZOS)
