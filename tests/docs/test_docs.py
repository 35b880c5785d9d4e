"""The documentation: what it names exists, its commands run, its site asks for nothing."""

import ast
import importlib.util
import pkgutil
import re
import shlex

import pytest

from tests.helpers import ROOT, warm

SMALL = ("profile=smoke", "metrics.judge=none", "preview.resolution=48",
         "preview.turntable_frames=2", "threads=1")  # fmt: skip
"""Added to the tutorial's runs, after their own `profile=fast`, so that they take seconds."""
LEARNED = ("encoder=vgg19_random",)
BY_SYNTHESIS = ("source.refine=none", "baseline.bank=500")


def rows():
    """The paper table's cells of code and test."""
    table = (ROOT / "docs" / "paper.md").read_text()
    return [
        (code, test)
        for line in table.splitlines()
        if "::" in line
        for *_, code, test in [[cell.strip(" `") for cell in line.strip("|").split("|")]]
    ]


def test_everything_that_the_paper_table_names_exists():
    found = rows()
    assert len(found) > 20
    for code, test in found:
        assert pkgutil.resolve_name(code) is not None, code
        file, _, function = test.partition("::")
        tree = ast.parse((ROOT / file).read_text())
        assert function in {each.name for each in tree.body if isinstance(each, ast.FunctionDef)}


def commands():
    """The tutorial's, in order."""
    text = (ROOT / "docs" / "tutorial.md").read_text()
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return [shlex.split(line) for block in blocks for line in block.splitlines()]


def test_the_tutorials_commands_run(tmp_path):
    """Each as it is written there, in one folder, with the overrides named above."""
    listed = commands()
    assert {name for name, *_ in listed} == {
        "styleexp-assets", "styleexp", "styleexp-metrics", "styleexp-report",
    }  # fmt: skip
    for name, *arguments in listed:
        module = "styleexp" + name.removeprefix("styleexp").replace("-", ".cli.")
        if name == "styleexp" and not arguments[0].startswith("resume="):
            arguments += [
                *SMALL,
                *(LEARNED if "method=paper_amended" in arguments else BY_SYNTHESIS),
            ]
        if name == "styleexp-metrics":
            arguments += ["--judge", "none"]
        done = warm.run("-m", module, *arguments, cwd=tmp_path, env=warm.coarse())
        assert done.returncode == 0, (name, arguments, done.stderr)
    assert {path.name for path in (tmp_path / "outputs").iterdir()} == {"first", "two", "learned"}
    for told in ("first/report.html", "learned/result.glb", "two/table.csv", "two/figure.png",
                 "two/report.html", "two/1/report.html"):  # fmt: skip
        assert (tmp_path / "outputs" / told).is_file(), told


@pytest.fixture(scope="module")
def hook():
    for name in ("mkdocs", "griffe"):
        pytest.importorskip(name, reason=f"{name} is not installed (extra docs)")
    spec = importlib.util.spec_from_file_location("site_hook", ROOT / "docs" / "hooks" / "site.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("page", "asks"),
    [
        ('<script defer src="https://cdn.example/x.js"></script>', True),
        ("<img alt='' src=//cdn.example/x.png>", True),
        ('<link rel="stylesheet" href="https://fonts.example/css">', True),
        ('<link href="https://fonts.example" rel="preconnect">', True),
        ("@font-face { src: url(https://fonts.example/a.woff2) }", True),
        ('<a href="https://example.org">a link is a link</a>', False),
        ('<link rel="canonical" href="https://example.org">', False),
        ('<script src="assets/x.js"></script><img src="images/x.png">', False),
    ],
)
def test_pages_that_would_ask_the_network_are_found(hook, page, asks):
    assert bool(hook.EXTERNAL.search(page)) == asks


def test_configuration_reference_has_every_key_with_its_meaning(hook):
    import dataclasses

    from styleexp.config import schema

    page = hook.configuration()

    def keys(schema, prefix=""):
        for field in dataclasses.fields(schema):
            value = getattr(schema(), field.name)
            if dataclasses.is_dataclass(value):
                yield from keys(type(value), f"{prefix}{field.name}.")
            else:
                yield prefix + field.name

    written = set(re.findall(r"^\| `([\w.]+)` \|", page, re.MULTILINE))
    assert set(keys(schema.Config)) <= written
    assert "| `optim.schedule` | `cosine` | `step`: multiply the rate" in page
    assert "One of `step`, `cosine`." in page
    assert "logger.mlflow.uri" in page
    assert "baseline.sharpness" in page


def test_links_into_the_repository_are_checked(hook):
    from mkdocs.exceptions import PluginError

    link = hook.repository_link
    assert link("`x`", "../src/styleexp/method/fields.py", None, "a.md") == (
        "[`x`](reference/api/method.fields.md)"
    )
    assert link("`conf/layers`", "../conf/layers", None, "a.md") == "`conf/layers`"
    assert link("plan", "../sweeps/paper.yaml", None, "a.md") == "plan (`sweeps/paper.yaml`)"
    with pytest.raises(PluginError, match="isn't there"):
        link("x", "../src/styleexp/nothing.py", None, "a.md")
