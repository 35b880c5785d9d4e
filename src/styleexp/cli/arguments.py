"""The words of the ``styleexp`` command, in the order and the grammar that Hydra wants."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from styleexp import overrides
from styleexp.errors import UserError, unknown_name

MULTIRUN = ("-m", "--multirun")
SWEPT = ("+experiment=", "experiment=", "+search=", "search=", "hydra.mode=MULTIRUN")
"""Overrides that make a sweep without ``-m``."""
REFUSED = {
    "--experimental-rerun": "runs what a pickle holds: go on with a run by resume=FOLDER",
}


def for_hydra(given: Sequence[str]) -> list[str]:
    """Flags first, then all else as overrides; words after ``--`` are no flags.

    Raises `UserError` for a flag that Hydra doesn't know, and for what `overrides.understood` can't
    make sense of.
    """
    flags, words = _parted(given)
    multirun = any(f in MULTIRUN for f in flags) or any(w.startswith(SWEPT) for w in words)
    if "--shell-completion" in flags or "-sc" in flags:
        return [*flags, *words]
    return [*flags, *overrides.understood(words, multirun)]


def _parted(given: Sequence[str]) -> tuple[list[str], list[str]]:
    from hydra._internal.utils import get_args_parser

    actions = get_args_parser()._option_string_actions
    flags: list[str] = []
    words: list[str] = []
    rest = iter(given)
    for word in rest:
        if word == "--":
            words += rest
        elif not word.startswith("-") or word == "-":
            words.append(word)
        else:
            name, equals, _ = word.partition("=")
            if name not in actions:
                raise unknown_name("flag", name, actions)
            if name in REFUSED:
                raise UserError(f"{name} is not supported, since it {REFUSED[name]}.")
            flags.append(word)
            action = actions[name]
            if not equals and action.nargs is None and _takes_a_value(action):
                value = next(rest, None)
                if value is None:
                    raise UserError(f"{name} needs a value: see styleexp --hydra-help.")
                flags.append(value)
    return flags, words


def _takes_a_value(action: argparse.Action) -> bool:
    return isinstance(action, argparse._StoreAction)
