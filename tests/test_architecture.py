"""How the packages may use each other; SECURITY.md and CONTRIBUTING.md describe the same."""

import graphlib
import subprocess
import sys
from pathlib import Path

import grimp
import pytest

import styleexp

PACKAGE = Path(styleexp.__file__).parent
LAYERS = (
    ("cli",),
    ("api", "testing"),
    ("experiments",),
    ("runs",),
    ("config",),
    ("plugins",),
    ("method",),
    ("renderers", "encoders"),
    ("inputs",),
    ("system",),
)
"""From what is built last to what everything is built on. Each may only use those below it."""
CORE = ("method", "renderers", "encoders", "inputs", "system")
"""What a script can use without a configuration."""
LIMIT = 450


@pytest.fixture(scope="module")
def graph():
    """Imports anywhere in a file, also inside functions; not those for type checkers alone."""
    return grimp.build_graph(
        "styleexp",
        include_external_packages=True,
        exclude_type_checking_imports=True,
        cache_dir=None,
    )


def own(graph):
    return sorted(m for m in graph.modules if m.split(".")[0] == "styleexp")


def test_no_modules_import_each_other_in_a_circle(graph):
    imports = {m: graph.find_modules_directly_imported_by(m) for m in own(graph)}
    graphlib.TopologicalSorter(imports).prepare()  # raises with the circle


def test_packages_use_only_what_is_below_them(graph):
    level = {name: number for number, names in enumerate(LAYERS) for name in names}
    parts = {m.split(".")[1] for m in own(graph) if "." in m} - {"__main__"}
    assert parts == set(level)
    for module in own(graph):
        part = module.partition(".")[2].split(".")[0]
        for used in graph.find_modules_directly_imported_by(module):
            other = used.removeprefix("styleexp.").split(".")[0]
            if part in level and used.startswith("styleexp.") and other != part:
                assert level[part] < level[other], f"{module} imports {used}"


def test_the_core_knows_neither_hydra_nor_the_configuration(graph):
    for module in own(graph):
        if module.startswith(tuple(f"styleexp.{part}" for part in CORE)):
            used = graph.find_modules_directly_imported_by(module)
            assert not used & {"hydra", "omegaconf", "hydra_plugins"}, module


@pytest.mark.parametrize(
    "module",
    [
        "cli.main",
        "config.compose",
        "config.schema",
        "config.sources",
        "plugins",
        "runs.reading",
        "runs.finding",
        "experiments.sweeps.plan",
    ],
)
def test_what_every_command_imports_is_light(module):
    code = (
        f"import sys, styleexp.{module}; print({{'torch', 'scipy', 'trimesh'}} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_the_top_has_at_most_twelve_parts():
    shown = {p.stem for p in PACKAGE.iterdir() if not p.name.startswith(("_", "."))} - {"py"}
    assert len(shown) <= 12, sorted(shown)


def test_no_file_is_longer_than_a_screenful_of_pages():
    long = {
        path.relative_to(PACKAGE).as_posix(): count
        for path in PACKAGE.rglob("*.py")
        if (count := len(path.read_text().splitlines())) > LIMIT
    }
    assert not long, long
