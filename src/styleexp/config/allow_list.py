"""Allow-list of Hydra targets: Hydra's own parts, its search plugin, and this package.

Hydra builds callbacks, launchers and sweepers from ``_target_``, and logging from ``()`` and
``class``, each of which may name any importable function. Configuration files get shared, so all
names are checked before anything is built.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from styleexp.system.errors import UserError

ALLOWED = ("hydra.", "hydra_plugins.", "optuna.samplers.", "styleexp.")
CALLED = ("_target_", "()")
LOGGING = ("logging.StreamHandler", "logging.FileHandler", "logging.NullHandler", "colorlog.")


def guard() -> None:
    """Check every configuration that Hydra composes in this process (see `load`). Safe to call
    again. It patches Hydra, so only call it in our own processes."""
    from hydra._internal.config_loader_impl import ConfigLoaderImpl

    real = ConfigLoaderImpl.load_configuration
    if getattr(real, "checked", False):
        return

    def load_configuration(*arguments: Any, **options: Any) -> Any:
        return load(lambda: real(*arguments, **options))

    load_configuration.checked = True  # type: ignore[attr-defined]
    ConfigLoaderImpl.load_configuration = load_configuration  # type: ignore[method-assign]


def load(compose: Callable[[], Any]) -> Any:
    """Call ``compose`` and check the result. Other exceptions than Hydra's own, raised for odd
    overrides, become `UserError`."""
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        config = compose()
    except (HydraException, OmegaConfBaseException, UserError):
        raise
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise UserError(f"the overrides can't be understood: {reason}.") from error
    check(config)
    return config


def check(config: Any) -> None:
    """Raise `UserError` if a configuration names a function or class that isn't allowed."""
    from omegaconf import OmegaConf

    for key, value in _named(OmegaConf.to_container(config, resolve=False)):
        last = key.rsplit(".", 1)[-1]
        allowed = ALLOWED if last == "_target_" else LOGGING if last == "class" else ()
        if not isinstance(value, str) or not value.startswith(allowed):
            raise UserError(
                f"the configuration has {key}={value}, which would run code from outside this "
                "package: remove it; to add your own parts, write a plugin "
                "(docs/write-a-backend.md)."
            )


def _named(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield keys and values of everything that Hydra would call."""
    for name, value in node.items() if isinstance(node, dict) else ():
        full = f"{key}.{name}" if key else str(name)
        in_logging = "logging" in key.split(".", 2)[:2][-1]
        if name in CALLED or (name == "class" and in_logging):
            yield full, value
        yield from _named(value, full)
    for number, value in enumerate(node) if isinstance(node, list) else ():
        yield from _named(value, f"{key}.{number}")
