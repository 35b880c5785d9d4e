"""Plugins as other packages bring them: real distributions on the path, real processes."""

import json
import os
import subprocess
import sys
import sysconfig
import textwrap
from pathlib import Path

import pytest

from tests.helpers import ROOT, warm

SMOKE = ["source=torus", "method=robust", "profile=smoke", "hydra.run.dir=run"]

GOOD = """
    from dataclasses import dataclass
    from styleexp.plugins import EncoderConfig, FieldConfig, LossConfig, StyleConfig
    from styleexp.plugins.spec import Spec

    @dataclass
    class Renderer:
        name: str = "lab_renderer"
        samples: int = 1

    @dataclass
    class Encoder(EncoderConfig):
        salt: int = 5

    @dataclass
    class Style(StyleConfig):
        period: int = 16

    @dataclass
    class Field(FieldConfig):
        gain: float = 1.0

    @dataclass
    class Loss(LossConfig):
        power: float = 1.0

    def renderer(options):
        from styleexp.renderers.soft_raster import SoftRaster
        print("samples", options.samples)
        return SoftRaster()

    def encoder(options, *, device, seed):
        from styleexp.plugins import load_encoder
        return load_encoder("vgg19_random", precision="fp32", device=device, seed=options.salt)

    def style(options):
        import numpy as np
        row = (np.arange(96) // options.period % 2).astype(np.float32)
        return np.broadcast_to(row[:, None, None], (96, 96, 3)).copy()

    def field(options, *, points, generator, sigma, bound):
        from styleexp.method.fields import FourierMLP
        return FourierMLP(options, generator, sigma * options.gain, bound)

    def loss(options, *, encoder):
        from styleexp.method.losses import GramLoss
        class Powered(GramLoss):
            def distance(self, *given):
                return super().distance(*given) ** options.power
        return Powered(options, encoder)

    def fails(options):
        raise RuntimeError("no licence server")

    RENDERER = Spec("lab_renderer", "counts its samples", Renderer, renderer)
    ENCODER = Spec("lab_encoder", "salted", Encoder, encoder)
    STYLE = Spec("lab_style", "a square wave", Style, style)
    FIELD = Spec("lab_field", "with a gain", Field, field)
    LOSS = Spec("lab_loss", "with a power", Loss, loss)
    NEEDY = Spec("needy", "needs more", Renderer, renderer, ("no_such_package",), "gpu")
    FAILING = Spec("failing", "fails when it is built", Renderer, fails)
    TWICE = Spec("twice", "one of two", Renderer, renderer)
    SHADOW = Spec("soft_raster", "wants a name that is taken", Renderer, renderer)
    QUICK = Spec("quick", "without a package", Renderer, renderer)
    BASELINE = Spec("lab_baseline", "listed", Renderer, renderer)
"""

GOOD_POINTS = """
    [styleexp.renderers]
    lab_renderer = lab:RENDERER
    [styleexp.encoders]
    lab_encoder = lab:ENCODER
    [styleexp.styles]
    lab_style = lab:STYLE
    [styleexp.fields]
    lab_field = lab:FIELD
    [styleexp.losses]
    lab_loss = lab:LOSS
    [styleexp.baselines]
    lab_baseline = lab:BASELINE
"""

WRONG = """
    from dataclasses import dataclass
    from styleexp.plugins.spec import Spec
    print("printed while it is imported")

    @dataclass
    class Own:
        name: str = "x"

    @dataclass
    class Nameless:
        samples: int = 1

    @dataclass
    class Untyped:
        name: str = "untyped"
        value: object() = None

    NO_SPEC = {"name": "no_spec"}
    OTHER_NAME = Spec("another", "", Own, print)
    NO_DATACLASS = Spec("no_dataclass", "", dict, print)
    NO_BASE = Spec("no_base", "", Own, print)
    NAMELESS = Spec("nameless", "", Nameless, print)
    UNTYPED = Spec("untyped", "", Untyped, print)
"""

WRONG_POINTS = """
    [styleexp.renderers]
    no_spec = wrong:NO_SPEC
    other_name = wrong:OTHER_NAME
    no_dataclass = wrong:NO_DATACLASS
    nameless = wrong:NAMELESS
    untyped = wrong:UNTYPED
    no_attribute = wrong:NOWHERE
    no_module = no_module_at_all:SPEC
    broken_import = broken_import:SPEC
    leaves = leaves:SPEC
    needy = lab:NEEDY
    failing = lab:FAILING
    [styleexp.losses]
    no_base = wrong:NO_BASE
    [styleexp.renderer]
    misspelt = wrong:NO_SPEC
"""


def distribution(folder, name, points, **modules):
    """What pip would leave of a package, in ``folder``."""
    info = folder / f"{name.replace('-', '_')}-1.2.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(textwrap.dedent(points))
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(textwrap.dedent(text))


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with good, wrong and quarrelling plugins."""
    folder = tmp_path_factory.mktemp("installed")
    distribution(folder, "lab-plugin", GOOD_POINTS, lab=GOOD)
    distribution(
        folder,
        "wrong-plugin",
        WRONG_POINTS,
        wrong=WRONG,
        broken_import="import nothing_of_that_name",
        leaves="import sys; sys.exit('gone')",
    )
    distribution(folder, "first", "[styleexp.renderers]\ntwice = lab:TWICE")
    distribution(
        folder, "second", "[styleexp.renderers]\ntwice = lab:TWICE\nsoft_raster=lab:SHADOW"
    )
    return folder


def environment(path, variables):
    found = {**os.environ, **variables}
    return found if path is None else {**found, "PYTHONPATH": str(path)}


def process(*command, cwd, path=None, **variables):
    """Any program, started anew."""
    return subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment(path, variables),
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


def styleexp(*arguments, cwd, path=None, **variables):
    env = warm.coarse(**environment(path, variables))
    return warm.run("-m", "styleexp", *arguments, cwd=cwd, env=env)


@pytest.fixture(scope="module")
def listed(installed, tmp_path_factory):
    """What ``styleexp-plugins --json`` says, by group and name."""
    # Entry points that can't be parsed are apart: torch can't be imported beside them.
    garbled = tmp_path_factory.mktemp("garbled")
    distribution(garbled, "garbled", "[styleexp.renderers]\nno equals sign here")
    distribution(garbled, "not-ours", "no section = x:y\ngarbage")
    path = f"{installed}{os.pathsep}{garbled}"
    done = process(sys.executable, "-m", "styleexp.cli.plugins", "--json", cwd=garbled, path=path)
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert all(list(r) == ["group", "name", "origin", "version", "usable", "reason"] for r in rows)
    return {(r["group"].removeprefix("styleexp."), r["name"], r["version"]): r for r in rows}


def options(shown, kind="renderer"):
    """The choices of a kind of part, as the help shows them."""
    (line,) = [line for line in shown.splitlines() if line.startswith(f"{kind}: ")]
    return line.removeprefix(f"{kind}: ").split(", ")


def test_built_in_parts_are_listed(listed):
    from styleexp import __version__

    for group, name in (
        ("renderers", "soft_raster"), ("encoders", "vgg16"), ("styles", "bubble"),
        ("fields", "fourier_mlp"), ("losses", "gram"),
    ):  # fmt: skip
        row = listed[group, name, __version__]
        assert (row["origin"], row["usable"], row["reason"]) == ("styleexp", True, None)


def test_plugins_are_listed_with_what_they_come_from(listed):
    kinds = {"renderers", "encoders", "styles", "fields", "losses", "baselines"}
    for group in kinds:
        name = f"lab_{group.removesuffix('es') if group == 'losses' else group[:-1]}"
        row = listed[group, name, "1.2"]
        assert row["usable"], row
        assert row["origin"].startswith("lab-plugin (lab:")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("no_spec", "is of type dict, not styleexp.plugins.spec.Spec"),
        ("other_name", "is named 'another', but its entry point is 'other_name'"),
        ("no_dataclass", "has a config that is not a dataclass"),
        ("nameless", "unexpected keyword argument 'name'|lacks the field 'name'"),
        ("untyped", "Unsupported|Unexpected|ValidationError"),
        ("no_attribute", "AttributeError: .*NOWHERE"),
        ("no_module", "ModuleNotFoundError: No module named 'no_module_at_all'"),
        ("broken_import", "ModuleNotFoundError: No module named 'nothing_of_that_name'"),
        ("leaves", "SystemExit: gone"),
        ("needy", r"needs no_such_package: pip install 'wrong-plugin\[gpu\]'"),
        ("no_base", "config Own, which does not derive from LossConfig"),
        ("misspelt", "unknown group 'styleexp.renderer': did you mean 'styleexp.renderers'"),
        ("garbled", "entry points can't be read"),
    ],
)
def test_what_is_wrong_is_said(listed, name, reason):
    import re

    (row,) = [r for r in listed.values() if r["name"] == name]
    assert not row["usable"]
    assert re.search(reason, row["reason"]), row["reason"]


def test_of_two_plugins_with_one_name_none_is_taken(installed, listed, tmp_path):
    row = listed["renderers", "twice", "1.2"]
    assert not row["usable"]
    assert "first (lab:TWICE)" in row["reason"]
    assert "second (lab:TWICE)" in row["reason"]
    done = styleexp("renderer=twice", "style=bubble", *SMOKE, cwd=tmp_path, path=installed)
    assert done.returncode == 2
    assert row["reason"] in done.stderr


def test_built_in_names_are_kept_and_the_refusal_is_told(installed, listed, tmp_path):
    refused = listed["renderers", "soft_raster", "1.2"]["reason"]
    assert refused == "styleexp has that name already, so second (lab:SHADOW) can't use it"
    done = styleexp("style=bubble", "optim.steps=0", *SMOKE, cwd=tmp_path, path=installed)
    assert "optim.steps=0" in done.stderr
    assert f"warning: renderer=soft_raster: {refused}." in done.stderr


def test_help_shows_the_options_and_names_the_broken_and_loads_nothing_heavy(installed, tmp_path):
    code = (
        "import sys; sys.argv = ['styleexp', 'renderer=lab_renderer', '--help']\n"
        "from styleexp.cli.main import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "heavy = {'torch', 'mitsuba', 'moderngl', 'pyrender', 'trimesh', 'scipy', 'onnx'}\n"
        "print('HEAVY', sorted(heavy & set(sys.modules)))"
    )
    done = process(sys.executable, "-c", code, cwd=tmp_path, path=installed)
    assert "HEAVY []" in done.stdout, done.stderr
    lines = done.stdout.splitlines()
    for kind in ("renderer", "encoder", "style", "field", "loss"):
        (choices,) = [line for line in lines if line.startswith(f"{kind}: ")]
        assert f"lab_{kind}" in choices
    assert "samples: 1" in done.stdout
    (broken,) = [line for line in lines if "see styleexp-plugins" in line]
    assert "renderer=broken_import" in broken
    (choices,) = [line for line in lines if line.startswith("renderer: ")]
    assert "broken_import" not in choices


def test_import_with_plugins_installed_loads_nothing(installed, tmp_path):
    code = (
        "import sys, styleexp; print(sorted({'torch', 'numpy', 'hydra', 'lab'} & set(sys.modules)))"
    )
    done = process(sys.executable, "-c", code, cwd=tmp_path, path=installed)
    assert done.stdout.strip() == "[]"


def test_a_broken_plugin_prints_its_error_when_it_is_used(installed, tmp_path):
    arguments = ("style=bubble", *SMOKE)
    told = "No module named 'nothing_of_that_name'"
    done = styleexp("renderer=broken_import", *arguments, cwd=tmp_path, path=installed)
    assert done.returncode == 2
    assert told in done.stderr
    assert "wrong-plugin (broken_import:SPEC)" in done.stderr
    assert "Traceback" not in done.stderr
    done = styleexp(
        "renderer=broken_import", "debug=true", *arguments, cwd=tmp_path, path=installed
    )
    assert "Traceback" in done.stderr
    assert "broken_import.py" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["renderer=lab_renderer", "renderer.samples=many"], "samples"),
        (["renderer=lab_renderer", "renderer.sample=3"], "there is no key 'sample'"),
        (["field=lab_field", "field.gain=much"], "gain"),
        (["field=lab_field", "field.depth=1"], "field.depth=1"),
        (["loss=lab_los"], "did you mean 'lab_loss'"),
        (["renderer.name=lab_rendere"], "did you mean 'lab_renderer'"),
        (["renderer=needy"], "needs no_such_package"),
        (["renderer=failing"], "RuntimeError: no licence server"),
    ],
)
def test_options_of_plugins_are_validated(installed, arguments, told, tmp_path):
    done = styleexp("style=bubble", *arguments, *SMOKE, cwd=tmp_path, path=installed)
    assert done.returncode == 2, done.stderr
    assert told in done.stderr
    assert "Traceback" not in done.stderr


def test_every_kind_of_plugin_runs_beside_broken_ones_and_resumes(installed, tmp_path):
    done = styleexp(
        "renderer=lab_renderer", "renderer.samples=7", "encoder=lab_encoder", "style=lab_style",
        "style.period=8", "field=lab_field", "field.gain=2", "field.sigma=3", "loss=lab_loss",
        "loss.power=0.5", "layers=low", *SMOKE, "method=paper", cwd=tmp_path, path=installed,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "samples 7" in done.stdout
    record = json.loads((tmp_path / "run/run.json").read_text())
    used = {p["kind"]: (p["name"], p["origin"], p["version"]) for p in record["plugins"]}
    assert set(used) == {"renderer", "encoder", "style", "field", "loss"}
    assert used["loss"] == ("lab_loss", "lab-plugin (lab:LOSS)", "1.2")
    config = record["config"]
    assert (config["field"]["gain"], config["field"]["sigma"]) == (2.0, 3.0)
    assert (config["loss"]["power"], config["loss"]["target"]) == (0.5, "same_views")
    assert config["loss"]["layers"][-1] == "conv2_2"
    assert (config["style"]["period"], config["style"]["scale_by"]) == (8, "frame")

    (tmp_path / "run/result.ply").unlink()
    done = styleexp("resume=run", cwd=tmp_path, path=installed)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run/result.ply").exists()


def test_a_style_of_a_plugin_from_python(installed, tmp_path):
    code = (
        "import styleexp\n"
        "r = styleexp.stylize('torus', 'lab_style', 'method=robust', 'profile=smoke', "
        "'encoder=vgg19_random', 'style.period=24')\n"
        "print(r.subject.settings.style.period, r.subject.style.picture.shape)"
    )
    done = process(sys.executable, "-c", code, cwd=tmp_path, path=installed)
    assert "24 (96, 96, 3)" in done.stdout, done.stderr


def test_the_guides_file_works_without_a_package(tmp_path):
    guide = (ROOT / "docs/write-a-backend.md").read_text()
    (tmp_path / "gentle.py").write_text(guide.split("```python\n")[1].split("```")[0])
    (tmp_path / "lab.py").write_text(textwrap.dedent(GOOD))
    named = {"STYLEEXP_PLUGINS": "renderer=gentle:GENTLE, field=lab:FIELD"}
    command = Path(sysconfig.get_path("scripts")) / "styleexp"  # its path lacks the folder we're in
    done = process(command, "renderer=gentle", "--help", cwd=tmp_path, **named)
    assert "gentle" in options(done.stdout), done.stderr
    assert "field: fourier_mlp, lab_field" in done.stdout
    done = process(
        command,
        "renderer=gentle",
        "renderer.limit=0",
        "style=bubble",
        *SMOKE,
        cwd=tmp_path,
        **named,
    )
    assert "renderer.limit=0.0 is not allowed" in done.stderr
    done = process(sys.executable, "-m", "styleexp.cli.plugins", cwd=tmp_path, **named)
    assert "STYLEEXP_PLUGINS (renderer=gentle:GENTLE)" in done.stdout


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("lab:QUICK", "is not KIND=MODULE:SPEC"),
        ("renderer=nowhere:QUICK", "No module named 'nowhere'"),
    ],
)
def test_a_mistake_in_the_variable_is_told_at_once(value, told, tmp_path):
    done = styleexp("--help-all", cwd=tmp_path, STYLEEXP_PLUGINS=value)
    assert done.returncode == 0
    assert "warning: STYLEEXP_PLUGINS: " in done.stderr
    assert told in done.stderr


@pytest.mark.parametrize("launcher", ["basic", "joblib", "submitit_local"])
def test_launchers(launcher, tmp_path):
    """A sweep over the options of a plugin that is only named in the environment."""
    if launcher != "basic":
        pytest.importorskip(f"hydra_plugins.hydra_{launcher.split('_')[0]}_launcher")
    (tmp_path / "lab.py").write_text(textwrap.dedent(GOOD))
    done = styleexp(
        "-m", f"hydra/launcher={launcher}", "renderer=quick,soft_raster", "source=torus",
        "style=bubble", "method=robust", "profile=smoke", "encoder=vgg19_random", "optim.steps=1",
        "preview.turntable_frames=1", "hydra.sweep.dir=all",
        cwd=tmp_path, STYLEEXP_PLUGINS="renderer=lab:QUICK",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for job, name in enumerate(("quick", "soft_raster")):
        status = json.loads((tmp_path / f"all/{job}/status.json").read_text())
        assert status["status"] == "done", status
        record = json.loads((tmp_path / f"all/{job}/run.json").read_text())
        assert record["config"]["renderer"]["name"] == name


def test_the_example_in_a_fresh_environment(tmp_path):
    """Built, installed beside our own wheel, found, run, held to the contract, uninstalled."""
    wheels, venv = tmp_path / "wheels", tmp_path / "venv"
    example = ROOT / "examples/styleexp-plugin-example"
    done = process(
        sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", wheels, ROOT, example,
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    python = venv / "bin/python"
    # torch and the others come from the environment of this test, styleexp must not.
    site = Path(sysconfig.get_path("purelib", vars={"base": str(venv)}))
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")

    def pip(*arguments):
        done = process(python, "-m", "pip", *arguments, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return done.stdout

    # --ignore-installed: pip must not touch the environment that is borrowed.
    pip("install", "--quiet", "--no-deps", "--no-index", "--ignore-installed", *wheels.glob("*"))
    where = process(python, "-c", "import styleexp; print(styleexp.__file__)", cwd=tmp_path).stdout
    assert where.startswith(str(venv)), where
    command = venv / "bin/styleexp"
    shown = process(command, "renderer=example_normals", "--help", cwd=tmp_path)
    assert "example_normals" in options(shown.stdout), shown.stderr
    assert "turn: 120.0" in shown.stdout
    rows = json.loads(process(venv / "bin/styleexp-plugins", "--json", cwd=tmp_path).stdout)
    (row,) = [r for r in rows if r["name"] == "example_normals"]
    assert row["usable"]
    assert row["origin"].startswith("styleexp-plugin-example (")

    done = process(
        command, "renderer=example_normals", "renderer.turn=90", "style=bubble", *SMOKE,
        "encoder=vgg19_random", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run/result.glb").exists()
    code = (
        "from styleexp import plugins, testing\n"
        "options = plugins.find('renderer', 'example_normals').spec.config()\n"
        "outcomes = testing.check_renderer(plugins.build('renderer', options))\n"
        "assert set(outcomes.values()) == {'passed'}, outcomes\n"
        "import functools\n"
        "encoder = plugins.load_encoder('vgg19_random')\n"
        "options = plugins.find('loss', 'example_moments').spec.config(name='example_moments')\n"
        "testing.check_loss(plugins.build('loss', options, encoder=encoder))\n"
        "options = plugins.find('field', 'example_waves').spec.config(name='example_waves')\n"
        "testing.check_field(functools.partial(plugins.build, 'field', options))\n"
    )
    done = process(python, "-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr

    pip("uninstall", "--quiet", "--yes", "styleexp-plugin-example")
    shown = process(command, "--help-all", cwd=tmp_path)
    assert "soft_raster" in options(shown.stdout)
    assert "example_normals" not in options(shown.stdout)
    done = process(command, "renderer=example_normals", cwd=tmp_path)
    assert "unknown renderer 'example_normals'" in done.stderr
