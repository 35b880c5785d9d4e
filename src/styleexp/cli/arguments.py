"""Convert the arguments of ``styleexp`` to Hydra's order and grammar."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from styleexp.config import overrides
from styleexp.system.errors import UserError, unknown_name

MULTIRUN = ("-m", "--multirun")
SWEPT = ("+experiment=", "experiment=", "+search=", "search=", "hydra.mode=MULTIRUN")
"""Overrides that imply a sweep without ``-m``."""
REFUSED = {
    "--experimental-rerun": "executes a pickle: continue a run with resume=FOLDER",
}


def for_hydra(given: Sequence[str]) -> list[str]:
    """Put flags first, then overrides; words after ``--`` are never flags.

    Raises `UserError` for a flag unknown to Hydra, and the errors of `overrides.understood`.
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
                raise UserError(f"{name} is not supported, because it {REFUSED[name]}.")
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
