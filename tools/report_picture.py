"""Take a picture of a report as a browser shows it: the pictures of the README.

    python tools/report_picture.py demo/report.html report.png [--width 1280] [--height 1180]

Needs Chromium.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

FLAGS = (
    "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking "
    "disable-component-update disable-sync hide-scrollbars"
)


def main() -> None:
    """Open the report without a window and save what it shows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=1180)
    arguments = parser.parse_args()
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not browser:
        sys.exit("report_picture.py: no Chromium was found on the PATH")
    with tempfile.TemporaryDirectory() as profile:
        options = [
            *(f"--{flag}" for flag in FLAGS.split()),
            f"--user-data-dir={profile}",
            f"--window-size={arguments.width},{arguments.height}",
            f"--screenshot={arguments.picture.resolve()}",
        ]
        subprocess.run([browser, *options, arguments.report.resolve().as_uri()], check=True, capture_output=True)


if __name__ == "__main__":
    main()
