"""The parts of the build that pyproject.toml cannot express: the folders of the package, and the README's links."""

import re
import tomllib
from pathlib import Path

from setuptools import find_packages, setup

HERE = Path(__file__).parent


def with_absolute_links(text: str, source: str) -> str:
    """Make the relative links of a Markdown text point to the repository on the web, pictures to their raw files."""

    def absolute(found: re.Match[str]) -> str:
        folder = "raw" if found[1] else "blob"
        return f"{found[1]}[{found[2]}]({source}/{folder}/main/{found[3]})"

    return re.sub(r"(!?)\[([^\]]*)\]\((?!https?://|#)([^)]+)\)", absolute, text)


if __name__ == "__main__":
    project = tomllib.loads((HERE / "pyproject.toml").read_text())["project"]
    readme, source = (HERE / "README.md").read_text(), project.get("urls", {}).get("Source")
    setup(
        # The scenes stay at the top of the repository, where users edit them, and are installed within the package.
        packages=[
            *find_packages(include=["mitsuba_plenoptic*"]),
            "mitsuba_plenoptic.scenes",
            "mitsuba_plenoptic.scenes.meshes",
        ],
        package_dir={"mitsuba_plenoptic.scenes": "scenes"},
        long_description=with_absolute_links(readme, source) if source else readme,
        long_description_content_type="text/markdown",
    )
