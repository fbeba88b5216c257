"""Running the command within the tests' process."""

from __future__ import annotations

import pytest

from mitsuba_plenoptic.cli import main


@pytest.fixture
def run(capfd):
    """Run the command, see that it succeeds, and return what it prints."""

    def run(*arguments):
        assert main([str(argument) for argument in arguments]) == 0
        return capfd.readouterr().out

    return run


@pytest.fixture
def complaint(capfd):
    """Run the command, see that it takes it as a user's mistake, and return the one line that it says."""

    def complaint(*arguments):
        capfd.readouterr()
        assert main([str(argument) for argument in arguments]) == 2
        output, error = capfd.readouterr()
        assert error.startswith("mitsuba-plenoptic: error: ")
        assert error.count("\n") == 1, error
        assert "Traceback" not in output + error
        return error.removeprefix("mitsuba-plenoptic: error: ").rstrip("\n")

    return complaint


@pytest.fixture(scope="session")
def raw(tmp_path_factory):
    """Render a small capture of the letters once."""
    path = tmp_path_factory.mktemp("capture") / "raw.exr"
    assert main(["render", "letters", "-o", str(path), "--spp", "4", "-D", "resolution=256"]) == 0
    return path
