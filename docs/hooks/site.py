"""What `mkdocs build` can't do by itself: pages made from the code, links into the repository, and the
promise that the site asks nothing of the network."""

import dataclasses
import importlib
import io
import os
import re
import typing
from contextlib import redirect_stdout, suppress
from functools import cache
from pathlib import Path

import griffe
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "styleexp"

API = {
    "The method": (
        "api", "method.base", "method.paper", "method.stepping", "method.subject", "method.scene", "method.options", "method.fields", "method.large_steps", "method.height_maps", "method.surface", "method.views", "method.viewer", "method.losses", "method.cell_losses", "method.targets", "method.relief", "method.refinement", "config.schema", "config.build", "method.baselines", "method.baselines.geometric_textures",
    ),
    "Synthesis on the surface": ("method.synthesis", "method.synthesis.method", "method.synthesis.shape", "method.synthesis.exemplar",
                                 "method.synthesis.direction", "method.synthesis.walk", "method.synthesis.optimise", "method.synthesis.room"),
    "Meshes and pictures": ("inputs.meshes", "inputs.meshes.mesh", "inputs.meshes.reading", "inputs.meshes.writing",
                            "inputs.meshes.remeshing", "inputs.meshes.refining", "inputs.meshes.simplifying", "inputs.meshes.memory", "inputs.meshes.welding", "inputs.meshes.joining", "inputs.meshes.precision",
                            "inputs.meshes.gltf", "inputs.meshes.accessors", "inputs.meshes.gltf_writing", "inputs.meshes.gltf_making",
                            "inputs.meshes.ply", "inputs.meshes.ply_meshes", "inputs.meshes.obj", "inputs.deep_images", "inputs.images", "inputs.shapes", "inputs.assets", "config.sources"),
    "Baking": ("runs.bake", "runs.bake.low", "runs.bake.tangents", "runs.bake.texels", "runs.bake.detail", "runs.bake.files", "runs.bake.glb"),
    "Renderers": ("renderers.base", "renderers.soft_raster", "renderers.soft_raster.renderer",
                  "renderers.soft_raster.culling", "renderers.soft_raster.raster", "renderers.soft_raster.boxes",
                  "renderers.soft_raster.contour", "renderers.soft_raster.composing",
                  "renderers.soft_raster.shading", "renderers.soft_raster.deferred",
                  "renderers.mitsuba_ad", "renderers.moderngl_deferred"),
    "Encoders": ("encoders", "encoders.base", "encoders.vgg", "encoders.fused", "encoders.clip", "inputs.weights"),
    "Parts and plugins": ("plugins", "plugins.spec", "plugins.code", "plugins.catalogue", "plugins.loggers", "testing", "testing.renderers", "testing.losses", "testing.fields", "testing.encoders", "testing.styles", "testing.methods", "system.options", "system.errors"),
    "Runs, metrics, reports": ("runs.records", "runs.reading", "runs.finding", "runs.jobs", "runs.results", "runs.untrusted", "runs.identity", "runs.origins", "runs.exports", "runs.provenance", "experiments.execute", "experiments.reproduce", "experiments.metrics", "experiments.metrics.style", "experiments.metrics.shape",
                               "experiments.metrics.truth", "experiments.reports", "experiments.reports.collect",
                               "experiments.reports.compare_page", "experiments.reports.reliability", "experiments.reports.study_results", "experiments.sweeps.claim", "experiments.sweeps.costs", "experiments.sweeps.plan", "experiments.sweeps.preflight", "experiments.sweeps.runner", "experiments.sweeps.state", "experiments.agreement", "method.gram_cache", "experiments.bench.render", "experiments.bench.step"),
}  # fmt: skip
COMMANDS = ("styleexp reproduce", "styleexp-assets", "styleexp-bake", "styleexp-bench", "styleexp-metrics",
            "styleexp-plugins", "styleexp-report", "styleexp-report study", "styleexp-studio", "styleexp-sweep")  # fmt: skip
EXTERNAL = re.compile(
    r"""<(?:script|img|iframe|source|video|audio)\b[^>]*\bsrc=["']?(?:https?:)?//[^"'\s>]*"""
    r"""|<link\b(?=[^>]*\brel=["']?(?:stylesheet|preload|preconnect|icon|prefetch|modulepreload))"""
    r"""[^>]*\bhref=["']?(?:https?:)?//[^"'\s>]*"""
    r"""|@import\s+(?:url\()?["']?(?:https?:)?//[^"')\s]*|url\(["']?(?:https?:)?//[^"')\s]*"""
)
API_PAGE = """---
title: styleexp.{0}
---

::: styleexp.{0}
    options:
      heading_level: 1
"""
SHIM = "https://unpkg.com/iframe-worker/shim"
LINK = re.compile(r"\[([^\]]+)\]\((\.\./[^)#\s]+)(#[^)\s]*)?\)")
OBJECT = re.compile(r"`(styleexp\.[\w.]+)`")


def on_config(config):
    """Offer the other versions, where `mike` keeps them; a single site has no such list."""
    if "MIKE_DOCS_VERSION" in os.environ:
        config.extra["version"] = {"provider": "mike"}


def on_files(files, config):
    """Add the pages that are made from the code."""
    made = {
        "reference/configuration.md": configuration(),
        "reference/commands.md": commands(),
        "reference/api.md": api_index(),
    }
    for modules in API.values():
        made |= {api_page(name): API_PAGE.format(name) for name in modules}
    for uri, content in made.items():
        files.append(File.generated(config, uri, content=content))
    return files


def on_page_markdown(markdown, page, config, files):
    """Links to files of the repository: to what the site says of a module, else the file's name."""
    if page.file.src_uri == "paper.md":
        markdown = OBJECT.sub(lambda found: f"[`{found[1]}`][{found[1]}]", markdown)
    return LINK.sub(lambda found: repository_link(*found.groups(), page.file.src_uri), markdown)


def repository_link(text, target, anchor, page):
    """What becomes of ``[text](../target)`` on a page in the top folder of the documentation."""
    path = (ROOT / "docs" / page).parent.joinpath(target).resolve()
    if not path.exists() or ROOT not in path.parents:
        raise PluginError(f"docs/{page} links to {target}, which isn't there")
    if PACKAGE in path.parents:
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")
        if name == "config":
            return f"[{text}](reference/configuration.md)"
        if any(name in modules for modules in API.values()):
            return f"[{text}]({api_page(name)})"
    told = str(path.relative_to(ROOT))
    return text if path.name in text.strip("`") or told in text else f"{text} (`{told}`)"


def on_post_page(output, page, config):
    """Refuse a page that would ask another machine for something. The search's helper for file://,
    which the theme would load from elsewhere, is here."""
    output = output.replace(SHIM, relative(page.url) + "assets/iframe-worker.js")
    found = EXTERNAL.search(output)
    if found:
        raise PluginError(f"{page.file.src_uri} would load {found[0]}: the site works offline")
    return output


def relative(url):
    """From a page back to the site's root."""
    return "../" * url.count("/")


def on_post_build(config):
    """The same for style sheets."""
    for path in Path(config["site_dir"]).rglob("*.css"):
        found = EXTERNAL.search(path.read_text(encoding="utf-8"))
        if found:
            raise PluginError(f"{path} would load {found[0]}: the site works offline")


# ---------------------------------------------------------------------------------- configuration


@cache
def _package():
    return griffe.load("styleexp", search_paths=[str(ROOT / "src")])


def source(name):
    """A module as it is written, with the strings below its fields."""
    return _package()[name]


def configuration():
    """Every key, its default and its meaning, from the dataclasses."""
    from styleexp import plugins
    from styleexp.config import schema

    out = [
        "# Configuration",
        "Every key of a run, as `styleexp KEY=VALUE` takes it, with the default of the schema. "
        "Presets (`method=`, `profile=`, `layers=`, …) set others: `method=synthesis`, which every "
        "run starts from, sets `baseline` and `source.refine=auto`. `styleexp --help-all` shows the "
        "values that a choice of them gives. This page is made from "
        "`styleexp/config/schema.py` and the options of the registered parts when the site is built.",
    ]
    kinds = typing.get_type_hints(schema.Config)
    sections = {name: kind for name, kind in kinds.items() if dataclasses.is_dataclass(kind)}
    top = [
        _row(schema.Config, field, field.name)
        for field in dataclasses.fields(schema.Config)
        if field.name not in sections
    ]
    out += ["## The run itself", *_table(top)]
    for name, kind in sections.items():
        out += _section(kind, name)
    out.append("## Options of parts")
    out.append(
        "What a part has beside its `name` and the keys above, written `KIND.KEY=VALUE` "
        "(`logger.NAME.KEY=VALUE`)."
    )
    for kind, about in plugins.KINDS.items():
        rows = []
        for spec in about.built_in.values():
            if spec.config is about.base:
                continue
            inherited = {f.name for f in dataclasses.fields(about.base)} if about.base else set()
            prefix = f"{kind}.{spec.name}" if kind == "logger" else kind
            for field in dataclasses.fields(spec.config):
                if field.name != "name" and field.name not in inherited:
                    row = _row(spec.config, field, f"{prefix}.{field.name}")
                    rows.append((f"`{spec.name}`", *row))
        if rows:
            out += [f"### {kind}", *_table(rows, ("name", "key", "default", "meaning"))]
    return "\n\n".join(out) + "\n"


def _section(kind, prefix):
    rows, nested = [], []
    for field in dataclasses.fields(kind):
        inner = typing.get_type_hints(kind)[field.name]
        if dataclasses.is_dataclass(inner):
            nested = _section(inner, f"{prefix}.{field.name}")
        else:
            rows.append(_row(kind, field, f"{prefix}.{field.name}"))
    return [f"## {prefix}", _prose(_written(kind).docstring.value), *_table(rows), *nested]


def _written(kind):
    """A dataclass as it is written."""
    return source(kind.__module__.removeprefix("styleexp."))[kind.__name__]


def _row(kind, field, key):
    owner = next(
        each for each in kind.__mro__ if field.name in vars(each).get("__annotations__", ())
    )
    attribute = _written(owner).members[field.name]
    told = [_prose(attribute.docstring.value)] if attribute.docstring else []
    limits = field.metadata
    if "choices" in limits:
        told.append("One of " + ", ".join(f"`{each}`" for each in limits["choices"]) + ".")
    if "between" in limits:
        told.append("From {} to {}.".format(*limits["between"]))
    elif "above" in limits:
        told.append(f"Above {limits['above']}.")
    return f"`{key}`", f"`{_default(field)}`", " ".join(told)


def _default(field):
    value = field.default
    if value is dataclasses.MISSING:
        value = field.default_factory()
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ", ".join(map(str, value)) + "]"
    return "{}" if value == {} else str(value)


def _table(rows, head=("key", "default", "meaning")):
    lines = ["| " + " | ".join(head) + " |", "| " + " | ".join("---" for _ in head) + " |"]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return ["\n".join(lines)] if rows else []


def _prose(text):
    return re.sub(r"``(.*?)``", r"`\1`", " ".join(text.split()))


# ------------------------------------------------------------------------------------ commands, API


def commands():
    """What every command says of itself."""
    out = ["# Commands", "`styleexp` takes the keys of the [configuration](configuration.md).", ""]
    for command in COMMANDS:
        name, *rest = command.removeprefix("styleexp").lstrip("- ").split()
        module = importlib.import_module(f"styleexp.cli.{name}")
        text = io.StringIO()
        with redirect_stdout(text), suppress(SystemExit):
            module.main([*rest, "--help"])
        out += [f"## {command}", "```text", text.getvalue().strip(), "```", ""]
    return "\n".join(out)


def api_index():
    """The modules, with the first sentence of each."""
    out = [
        "# Python",
        "`import styleexp` is instant; what is heavy is imported when it is used.",
        "",
    ]
    for heading, modules in API.items():
        out += [f"## {heading}", ""]
        for name in modules:
            doc = source(name).docstring
            first = _prose(doc.value.split("\n\n")[0]) if doc else ""
            out.append(
                f"- [`styleexp.{name}`]({api_page(name).removeprefix('reference/')}): {first}"
            )
        out.append("")
    return "\n".join(out)


def api_page(name):
    """Where a module's page lies."""
    return f"reference/api/{name}.md"
