"""The harness of `tools/bench`: options, verdicts, results, and the tables of the pages."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from tools.bench import Pivot, at_least, at_most, case, registry, tables, timing
from tools.bench.__main__ import PAGES, main, write_docs

ROOT = Path(__file__).parents[2]
TEXTS = {page: page.read_text() for pattern in PAGES for page in sorted(ROOT.glob(pattern))}


@pytest.fixture
def probe():
    """A case with an option, limits and a file of its own."""

    @case(
        "probe.one",
        "nothing",
        {"name": "{name}", "error": "{error:.1f}"},
        (at_most("error", 2.0), at_least("score", "least")),
        pivot=Pivot("{name}", "errors", "{error:.1f}"),
        quick={"errors": (1.0,)},
    )
    def measure(output: Path, *, errors: tuple[float, ...] = (1.0, 2.0), least: float = 0.0):
        """Yield what is asked."""
        (output / "picture.png").write_text("")
        for error in errors:
            yield {"name": f"of {error:g}", "error": error, "score": 1.0, "least": least}

    yield registry.CASES["probe.one"]
    del registry.CASES["probe.one"]


def results(folder):
    return json.loads((folder / "probe.one.json").read_text())


def test_a_figure_within_its_limit_is_ok_and_beyond_it_fails(probe, tmp_path, capsys):
    assert main(["run", "probe", "--output", str(tmp_path)]) == 0
    assert [row["verdict"] for row in results(tmp_path)["rows"]] == ["ok", "ok"]
    assert "| of 2 | 2.0 | ok |" in capsys.readouterr().out
    assert main(["run", "probe.one", "errors=1,2.5", "--output", str(tmp_path)]) == 1
    assert results(tmp_path)["rows"][1]["verdict"] == "FAILED: error 2.5, at most 2"
    assert main(["run", "probe.one", "least=3", "--output", str(tmp_path)]) == 1
    assert (tmp_path / "probe.one" / "picture.png").exists()


def test_nan_fails_and_so_does_a_run_that_judges_nothing(probe, tmp_path):
    assert probe.verdict({"error": float("nan")}).startswith("FAILED")
    assert probe.verdict({"name": "neither figure"}) == ""
    assert main(["run", "probe.one", "errors=", "--output", str(tmp_path)]) == 1


def test_a_limit_that_nothing_exceeds_is_refused():
    with pytest.raises(ValueError, match="never be exceeded"):
        at_most("error", "limit").judge({"error": 1.0, "limit": float("inf")})
    assert at_least("score", 0.994, digits=3).judge({"score": 0.99351})
    assert not at_least("score", 0.994).judge({"score": 0.99351})


def test_a_case_that_cannot_run_here_leaves_the_others_to_run(probe, tmp_path, capsys):
    @case("probe.two", "nothing", needs=("no_such_package",))
    def measure():
        """Yield nothing."""
        yield from ()

    try:
        assert main(["run", "probe", "--output", str(tmp_path)]) == 2
    finally:
        del registry.CASES["probe.two"]
    found = capsys.readouterr()
    assert "probe.two: NOT RUN: it needs no_such_package" in found.err
    assert "2 cases; FAILED: none; not run: probe.two" in found.out and results(tmp_path)["rows"]


def test_docs_write_full_results_with_the_options_of_the_mark(probe, tmp_path, capsys):
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    mark = "<!-- bench: probe.one{} -->\n\n{}\n<!-- /bench -->\n"
    page.write_text(mark.format("", "old") + mark.format(" errors=2", "kept"))
    output = tmp_path / "results"
    for words, written in ((["--quick"], False), (["least=0.5"], False), ([], True)):
        main(["run", "probe.one", *words, "--output", str(output)])
        assert write_docs(tmp_path, output, check=True) == written
    assert "old" in page.read_text()
    write_docs(tmp_path, output)
    text = page.read_text()
    assert "|  | errors |\n|---|---|\n| of 1 | 1.0 |\n| of 2 | 2.0 |\n" in text and "old" not in text
    assert "kept" in text
    assert write_docs(tmp_path, output, check=True) == 0


def test_ratios_are_taken_run_by_run(monkeypatch):
    # A machine grows slower by half from run to run, of which the first does not count.
    clock, order = [0.0], []
    watch = SimpleNamespace(perf_counter=lambda: clock[0], process_time=lambda: clock[0] / 4)
    monkeypatch.setattr(timing, "time", watch)

    def work(name, seconds):
        order.append(name)
        clock[0] += seconds * 1.5 ** (len(order) // 2)

    found = timing.paired({"a": lambda: work("a", 1.0), "b": lambda: work("b", 1.0)}, 3)
    assert order == ["a", "b"] * 4
    assert found["a"] == timing.Timing(1.5**2, 1.5**2 / 4, 1, 1)
    assert found["b"].ratio == found["b"].processor_ratio == pytest.approx(1.5)
    assert found["b"].seconds == pytest.approx(1.5**3) and found["b"].processor == pytest.approx(1.5**3 / 4)


def test_cases_name_a_page_that_names_them_or_their_group_in_a_command():
    for each in registry.load().values():
        if each.page:
            named = set(re.findall(r"[\w.-]+", " ".join(commands(TEXTS[ROOT / each.page]))))
            assert {each.name, each.name.split(".")[0]} & named, f"{each.page} has no command for {each.name}"


def commands(text):
    # In Markdown a line break within a command is a space.
    return [
        found.replace("\n", " ")
        for found in re.findall(r"python\s-m\stools\.bench\srun\s([^`#;]*?)(?=`|#|;|\n\n|\n\w|\n```)", text)
    ]


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_marks_of_pages_exist(page):
    for command in commands(TEXTS[page]):
        words = command.split()
        found = registry.find([word for word in words if "=" not in word and word != "--quick"])
        registry.options(found, [word for word in words if "=" in word])
    for name, words in tables.marked(TEXTS[page]):
        (found,) = registry.find([name])
        assert page == ROOT / found.page
        registry.options([found], words)
    assert len(tables.marked(TEXTS[page])) == TEXTS[page].count("<!-- bench:") == TEXTS[page].count("<!-- /bench")
