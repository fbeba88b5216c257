"""Take a picture of a report, or of the viewer, as a browser shows it.

    python tools/report_picture.py demo/report.html report.png [--width 1280] [--height 1180]

Needs Chromium with its driver on the PATH, and Selenium, which the extra ``test`` installs.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

FLAGS = (
    "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking "
    "disable-component-update disable-sync hide-scrollbars"
)


def main() -> None:
    """Open the page without a window, wait until it is complete, and save what it shows."""
    from selenium import webdriver
    from selenium.webdriver.support.wait import WebDriverWait

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=1180)
    arguments = parser.parse_args()
    options = webdriver.ChromeOptions()
    for flag in FLAGS.split():
        options.add_argument(f"--{flag}")
    # The installed driver: without its path, Selenium would look for one on the network.
    service = webdriver.ChromeService(shutil.which("chromedriver"))
    with webdriver.Chrome(options=options, service=service) as browser:
        size = {"width": arguments.width, "height": arguments.height, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get(arguments.report.resolve().as_uri())
        WebDriverWait(browser, 60).until(lambda seen: not seen.find_elements("css selector", "[aria-busy]"))
        browser.save_screenshot(str(arguments.picture))


if __name__ == "__main__":
    main()
