"""Everything public is documented, the site's reference has it, and examples of docstrings give what they state."""

import doctest
import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import generated_reference
import pytest

import mitsuba_plenoptic
from mitsuba_plenoptic.camera.entry import Form
from mitsuba_plenoptic.camera.parameters import PARAMETERS
from mitsuba_plenoptic.cli import COMMANDS, load
from mitsuba_plenoptic.extensions.laser import laser_integrator as laser
from mitsuba_plenoptic.lenses.protocol import Light, MainLens
from mitsuba_plenoptic.plugins import integrator, wave_base

ROOT = Path(__file__).parents[2]

PAGES = "\n".join(page.read_text() for page in (ROOT / "docs" / "reference" / "python").glob("*.rst"))

# Those that users import from, whose members the pages of the reference list.
MODULES = sorted(
    name
    for name, options in re.findall(r"^\.\. automodule:: (\S+)\n((?:   :.*\n)*)", PAGES, flags=re.MULTILINE)
    if ":no-members:" not in options
)


# Libraries that few have installed, by the modules that need them.
LIBRARIES = {f"mitsuba_plenoptic.{name}": name for name in ("hcipy", "jax", "torch")}


def public_names(module):
    """Names that a module offers: of its own if it does not list them."""
    listed = getattr(module, "__all__", None)
    own = [name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
    return [name for name in (own if listed is None else listed) if not name.startswith("_")]


def documented(docstring):
    """Names that the sections for parameters and attributes of a NumPy docstring describe."""
    # What a camera and the path of a file are, names and types say.
    found = {"camera", "path"}
    sections = r"^(?:Parameters|Attributes)\n-+\n(.*?)(?=^\S[^\n]*\n-{3,}$|\Z)"
    for section in re.findall(sections, inspect.cleandoc(docstring or ""), flags=re.MULTILINE | re.DOTALL):
        for line in re.findall(r"^([*\w][\w, *]*?)(?: :.*)?$", section, flags=re.MULTILINE):
            found |= {name.strip("* ") for name in line.split(",")}
    return found


def missing(thing, name, inherited=frozenset()):
    """What is not said of a function, a class or a module's constant."""
    if inspect.isclass(thing):
        yield from missing_of_class(thing, name)
    elif inspect.isroutine(thing):
        if not thing.__doc__:
            yield f"{name}: no docstring"
        said = documented(thing.__doc__) | inherited
        parameters = [p for p in inspect.signature(thing).parameters if p not in ("self", "cls")]
        # A docstring of one line says all of a function of one or two plain arguments in its sentence.
        if len((thing.__doc__ or "").strip().splitlines()) > 1 or len(parameters) > 2:
            yield from (f"{name}({parameter})" for parameter in parameters if parameter not in said)


def missing_of_class(cls, name):
    """What is not said of a class, of its constructor's parameters and of its methods."""
    if not cls.__doc__ or cls.__doc__.startswith(f"{cls.__name__}("):
        yield f"{name}: no docstring"
        return
    said = documented(cls.__doc__)
    for base in cls.__mro__[1:]:
        said |= documented(base.__doc__)
    is_called = cls.__init__ is not object.__init__ and not getattr(cls, "_is_protocol", 0)
    if is_called and not issubclass(cls, BaseException):
        parameters = list(inspect.signature(cls.__init__).parameters)[1:]
        yield from (f"{name}({parameter})" for parameter in parameters if parameter not in said)
    bases = [base for base in cls.__mro__ if base.__module__.startswith("mitsuba_plenoptic")]
    for owner, member, value in ((base, *item) for base in bases for item in vars(base).items()):
        if member.startswith("_"):
            continue
        function = value.__func__ if isinstance(value, (classmethod, staticmethod)) else value
        if isinstance(function, property) and not function.__doc__:
            yield f"{name}.{member}: no docstring"
        elif inspect.isfunction(function) and not _inherits(owner, member):
            yield from missing(function, f"{name}.{member}", frozenset(said))


def _inherits(cls, member):
    """Whether a method does what its class's base, the plain data of lenses, or a protocol of lenses documents."""
    protocols = (MainLens, Light) if cls.__module__.startswith("mitsuba_plenoptic.lenses") else ()
    return any(hasattr(base, member) for base in (*cls.__mro__[1:], *protocols) if base is not cls)


@pytest.mark.parametrize("name", MODULES)
def test_public_names_and_parameters_are_documented(name):
    if name in LIBRARIES:
        pytest.importorskip(LIBRARIES[name])
    module = importlib.import_module(name)
    assert module.__doc__
    found = [text for each in public_names(module) for text in missing(getattr(module, each), f"{name}.{each}")]
    assert found == []


def test_every_public_package_has_a_page():
    root = Path(mitsuba_plenoptic.__file__).parent
    offered = [path.parent for path in root.rglob("__init__.py") if "__all__" in path.read_text()]
    packages = {".".join(("mitsuba_plenoptic", *path.relative_to(root).parts)) for path in offered}
    assert packages - set(re.findall(r"automodule:: (\S+)", PAGES)) == set()


def test_every_option_has_a_help():
    commands = {name: load(name) for name in COMMANDS}
    assert all(command.help for command in commands.values())
    assert {(name, p.name) for name, command in commands.items() for p in command.params if not p.help} == set()


SENSOR_NAMES = {name for name, entry in PARAMETERS.items() if entry.form is not Form.FILM}


def read_by(module):
    """Names of the parameters that a plugin's file reads."""
    text = inspect.getsource(module)
    return set(re.findall(r"read_\w+\(props,(?: NAME,| plugin,)? \"(\w+)\"", text))


@pytest.mark.parametrize(
    "name, read",
    [
        ("plenoptic", SENSOR_NAMES),
        ("plenoptic_wave", read_by(integrator) | read_by(wave_base) | {"wavelength"}),
        ("plenoptic_laser", read_by(laser) | {"modes", *laser.SOURCE}),
    ],
)
def test_plugins_document_what_they_read(name, read):
    rows = generated_reference.plugin_parameters(generated_reference.plugin_docstring(name))
    documented = {each for names, *_ in rows for each in names.split(", ")}
    # Mitsuba itself reads these.
    assert documented - {"(Nested plugin)", "to_world", "shutter_open", "shutter_close"} == read
    assert all(text.strip() for _, _, text, *_ in rows)


def test_pages_made_from_the_sources():
    plugins, command = generated_reference.plugins(""), generated_reference.commands("")
    assert "``mla_pitch``" in plugins and "|" not in plugins.split("The sensor")[1].split("All lengths")[0]
    assert "``--method " in command and "[bold]" not in command
    # Outside of code, two hyphens would become a dash.
    prose = [line for line in re.sub(r"``[^`]*``", "", command).splitlines() if not line.startswith("   $ ")]
    assert "``--estimate``" in command and not [line for line in prose if re.search(r"--\w", line)]
    assert "| `undersampled` |" in generated_reference.guards("GUARDS")


INDEX = Path(__file__).parents[2] / "docs" / "reference" / "python" / "index.rst"
MAIN = re.findall(r"^   ~mitsuba_plenoptic\.(\S+)$", INDEX.read_text(), flags=re.MULTILINE)
"""The functions that the reference names as those that most scripts need."""
assert len(MAIN) >= 20


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in ("reconstruct", "report.plots.contact_sheet")))
        for name in MAIN
    ],
)
def test_example_gives_what_it_states(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module, _, last = f"mitsuba_plenoptic.{name}".rpartition(".")
    docstring = pkgutil.resolve_name(f"{module}:{last}").__doc__
    example = doctest.DocTestParser().get_doctest(docstring, {}, name, None, 0)
    assert example.examples, "no example"
    report = []
    doctest.DocTestRunner().run(example, out=report.append)
    assert not report, "".join(report)
