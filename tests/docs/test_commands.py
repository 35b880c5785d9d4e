"""Every command that README, documentation and --help print is understood as it is written."""

import argparse
import importlib
import re
import shlex

import hydra
import pytest

from tests.helpers import ROOT

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
GUIDES = ("gentle", "mean_vgg", "waves", "moments", "my_baseline", "my_renderer")
"""Parts that guides have their reader write; the guides' own tests run them."""
FILES = (
    *(
        "my.obj",
        "low.obj",
        "my.glb",
        "my_head.obj",
        "head.obj",
        "coarse.stl",
        "her.ply",
        "bark.jpg",
    ),
    *("bark.png", "peeling.jpg", "height.png", "normal.png", "outputs/upper/result.ply"),
)
"""The reader's files."""


def printed():
    """Every command, without its comment, as words; with the page that has it first."""
    from styleexp.cli.main import HELP, USAGE
    from styleexp.config.compose import _header

    found = {}
    for page in PAGES:
        code = fenced = False
        for line in page.read_text().replace("\\\n", " ").splitlines():
            if line.startswith("```"):
                fenced = not fenced
            code = fenced or line.startswith("    ")
            if code and re.match(r" *(\w+=\S+ )*styleexp(-\w+)? ", line):
                words = shlex.split(line, comments=True)
                found.setdefault(tuple(words), page.name)
    for text in (USAGE, HELP, _header([])):
        for line in re.findall(r"^  (styleexp .*)$", text, re.MULTILINE):
            words = shlex.split(re.split(r"  +", line)[0])
            found.setdefault(tuple(words), "--help")
    return {words: page for words, page in found.items() if not set(" ".join(words)) & set("[…")}


def runs(words):
    """Whether the command makes runs, and of parts that there are."""
    told = " ".join(words)
    return (
        words[0] == "styleexp"
        and not words[1].startswith("/")  # a file list of a container's recipe
        and words[1] not in ("reproduce", "--help", "--help-all", "--version")
        and "resume=" not in told
        and "search" not in told  # a search draws its jobs' values
        and not any(name in told for name in GUIDES)
    )


def test_there_are_commands_of_every_kind():
    assert sum(map(runs, printed())) > 50
    assert len({words[0] for words in printed()}) >= 8


def test_runs_are_composed(tmp_path, monkeypatch):
    """All keys, names and values of each, also of an experiment's first and last job."""
    from styleexp.cli.arguments import for_hydra
    from styleexp.config import compose
    from styleexp.config.many import Composer
    from styleexp.experiments.sweeps.plan import experiment_jobs

    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("the reader's")
    monkeypatch.chdir(tmp_path)
    asked = []
    for words, page in printed().items():
        if runs(words):
            flags_and_words = for_hydra(words[1:])
            overrides = [word for word in flags_and_words if not word.startswith("-")]
            asked.append((page, words, overrides, "-m" in flags_and_words))
    compose.register()
    jobs = []
    for page, words, overrides, several in asked:
        swept = several or any(word.startswith("+experiment=") for word in words)
        listed = experiment_jobs(overrides) if swept else [overrides]
        jobs += [(f"{page}: {shlex.join(words)}", each) for each in (listed[0], listed[-1])]
    with hydra.initialize_config_module("styleexp.conf", version_base="1.3"):
        composer = Composer()
        for told, each in jobs:
            config = composer.compose([*each, "hydra.mode=RUN"])
            assert config.source.name or config.source.path, told
            assert config.style.name or config.style.path, told


class Parsed(Exception):
    """The command's arguments are understood; it isn't run."""


def test_other_commands_are_parsed(monkeypatch, capsys):
    for name in ("parse_args", "parse_intermixed_args"):
        parse = getattr(argparse.ArgumentParser, name)

        def stop(*given, parse=parse):
            parse(*given)
            raise Parsed

        monkeypatch.setattr(argparse.ArgumentParser, name, stop)
    for words, page in printed().items():
        if (command := words[0].removeprefix("styleexp-")) == words[0]:
            continue
        module = importlib.import_module(f"styleexp.cli.{command}")
        try:
            module.main(list(words[1:]))
        except Parsed:
            continue
        except SystemExit:
            pytest.fail(f"{page}: {shlex.join(words)}\n{capsys.readouterr().err}")
        pytest.fail(f"{page}: {shlex.join(words)} was run")
