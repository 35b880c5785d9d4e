"""The commands in processes of their own that need not load everything first.

To start Python and to load torch, hydra, scipy and the rest takes five seconds of a processor,
longer than most of what the tests run. So one process, the nursery, has loaded them all, has done
nothing else, and forks: what is forked has its own arguments, environment, working folder, outputs
and session, runs ``python -m MODULE`` to its end as a new interpreter would, and can be killed.

What is about the interpreter itself stays with ``subprocess``: what an import loads, how a terminal
is encoded, how much memory a process takes, what is installed.
"""

from __future__ import annotations

import atexit
import functools
import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import types
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

PIPE = subprocess.PIPE

LOADED = (
    "styleexp.cli",  # first: it says how threads wait
    "antlr4", "gpytoolbox", "hydra._internal.hydra", "hydra.core.override_parser.overrides_parser",
    "imagecodecs", "jinja2", "PIL.Image", "PIL.GifImagePlugin", "PIL.ImageDraw", "PIL.ImageFont",
    "PIL.PngImagePlugin", "rich.console", "rich.progress", "safetensors.torch",
    "scipy.interpolate", "scipy.ndimage", "scipy.optimize", "scipy.sparse.csgraph",
    "scipy.sparse.linalg", "scipy.spatial", "tifffile", "torch", "torch._dynamo", "trimesh",
    "hydra._internal.core_plugins.basic_launcher", "hydra._internal.core_plugins.basic_sweeper",
    "styleexp.experiments.agreement", "styleexp.method.baselines.face_gan",
    "styleexp.method.baselines.geometric_textures", "styleexp.cli.bake", "styleexp.cli.main",
    "styleexp.cli.metrics", "styleexp.cli.report", "styleexp.experiments.execute",
    "styleexp.cli.sweep", "styleexp.encoders.vgg", "styleexp.inputs.images",
    "styleexp.experiments.metrics.board", "styleexp.experiments.reports.page",
    "styleexp.experiments.reports.sweep_page", "styleexp.renderers.soft_raster", "styleexp.api",
    "styleexp.experiments.sweeps.figure", "styleexp.experiments.sweeps.runner",
    "styleexp.method.synthesis.method", "styleexp.method.synthesis.optimise",
    "styleexp.config.unread",
)  # fmt: skip
"""What nearly every run loads. Nothing that opens a display or looks at the environment for more
than the number of threads: that is the forked process's own."""


# ---------------------------------------------------------------------------------------- for tests


COARSE = Path(__file__).parent / "coarse"


def coarse(**variables: str) -> dict[str, str]:
    """This process's environment, these variables, and coarse shapes (``coarse/sitecustomize.py``):
    for runs whose result nobody looks at closely."""
    environment = {**os.environ, **variables}
    given = environment.get("PYTHONPATH")
    path = os.pathsep.join([str(COARSE), *([given] if given else [])])
    return {**environment, "PYTHONPATH": path}


def run(
    *words: object,
    cwd: Path | str | None = None,
    env: Mapping[str, str] | None = None,
    timeout: float = 600,
) -> subprocess.CompletedProcess[str]:
    """What ``python *words`` printed and returned, as `subprocess.run` has it.

    The words begin with ``-m MODULE`` or ``-c CODE``.
    """
    process = start(*words, cwd=cwd, env=env, stdout=PIPE, stderr=PIPE)
    out, err = process.communicate(timeout)
    given = [sys.executable, *map(str, words)]
    return subprocess.CompletedProcess(given, process.returncode, out, err)


def start(
    *words: object,
    cwd: Path | str | None = None,
    env: Mapping[str, str] | None = None,
    stdout: int | IO[Any] | None = None,
    stderr: int | IO[Any] | None = None,
    start_new_session: bool = False,
) -> Process:
    """The same, begun; the outputs are this process's own, a file, or ``PIPE``."""
    kind, what, *arguments = map(str, words)
    assert kind in ("-m", "-c")
    asked = {
        "kind": kind,
        "what": what,
        "arguments": arguments,
        "cwd": str(cwd or os.getcwd()),
        "env": {key: str(value) for key, value in (os.environ if env is None else env).items()},
        "session": start_new_session,
    }
    return Process(asked, stdout, stderr)


class Process:
    """What of `subprocess.Popen` the tests use, for a process that the nursery forked."""

    def __init__(self, asked: dict[str, Any], stdout: Any, stderr: Any) -> None:
        self.returncode: int | None = None
        self.stdout, out = _end(stdout, 1)
        self.stderr, err = _end(stderr, 2)
        self._told, theirs = socket.socketpair()
        with _LOCK:
            socket.send_fds(_nursery(), [b"!"], [theirs.fileno(), out, err])
        theirs.close()
        for end, given in ((out, stdout), (err, stderr)):
            if given == PIPE:
                os.close(end)
        self._told.sendall(json.dumps(asked).encode())
        self._told.shutdown(socket.SHUT_WR)
        self._answers = self._told.makefile()
        self.pid = int(self._answers.readline())

    def poll(self) -> int | None:
        """The exit code; None while it lives."""
        if self.returncode is None:
            self._told.settimeout(0)
            try:
                self._ended()
            except (BlockingIOError, TimeoutError):
                return None
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; the exit code, with a minus for the signal that ended it."""
        if self.returncode is None:
            self._told.settimeout(timeout)
            try:
                self._ended()
            except TimeoutError:
                raise subprocess.TimeoutExpired("a forked process", timeout or 0) from None
        assert self.returncode is not None
        return self.returncode

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """All that it prints until its end; ended after ``timeout`` seconds, it is an error."""
        told = {1: "", 2: ""}

        def read(number: int, stream: IO[str] | None) -> None:
            if stream is not None:
                with stream:
                    told[number] = stream.read()

        readers = [
            threading.Thread(target=read, args=pair, daemon=True)
            for pair in ((1, self.stdout), (2, self.stderr))
        ]
        for reader in readers:
            reader.start()
        try:
            self.wait(timeout)
        except subprocess.TimeoutExpired:
            self.kill()
            raise
        for reader in readers:
            reader.join()
        return told[1], told[2]

    def send_signal(self, number: int) -> None:
        """Send it a signal, if it still lives."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """Signal 9."""
        self.send_signal(signal.SIGKILL)

    def _ended(self) -> None:
        answer = self._told.recv(64)
        self.returncode = int(answer) if answer else -signal.SIGKILL
        self._told.close()


_LOCK = threading.Lock()


def _end(given: Any, default: int) -> tuple[IO[str] | None, int]:
    """Our end of an output where it is a pipe, and the forked process's."""
    if given == PIPE:
        ours, theirs = os.pipe()
        return open(ours, encoding="utf-8"), theirs
    if given is None:
        return None, default
    return None, given if isinstance(given, int) else given.fileno()


@functools.cache
def _nursery() -> socket.socket:
    """Start the nursery, once for each process of tests; it ends when that process does."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    nursery = subprocess.Popen(
        [sys.executable, __file__, str(theirs.fileno())], pass_fds=[theirs.fileno()],
        cwd="/", stdin=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    theirs.close()

    def end() -> None:
        ours.close()
        nursery.wait()

    atexit.register(end)
    return ours


# ------------------------------------------------------------------------------------- the nursery


def _load() -> None:
    import gc
    import importlib
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in LOADED:
            importlib.import_module(name)
    gc.collect()
    gc.freeze()  # so that collecting garbage copies no page of what all share


def _serve(control: socket.socket) -> dict[str, Any]:
    """Fork for each who asks; returns in the forked process only, with what it is to do."""
    while True:
        asked, ends, _, _ = socket.recv_fds(control, 1, 3)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:  # keepers that have ended
                pass
        if not asked:
            sys.exit()
        if os.fork() == 0:
            control.close()
            return _keep(*ends)
        for end in ends:
            os.close(end)


def _keep(asking: int, out: int, err: int) -> dict[str, Any]:
    """Fork once more, wait for the end and tell it: to whom a process belongs learns its end."""
    with socket.socket(fileno=asking) as told:
        with told.makefile() as lines:
            asked: dict[str, Any] = json.load(lines)
        forked = os.fork()
        if forked:
            for end in (out, err):
                os.close(end)
            told.sendall(f"{forked}\n".encode())
            _, status = os.waitpid(forked, 0)
            told.sendall(str(os.waitstatus_to_exitcode(status)).encode())
            os._exit(0)
    # A shell's background job, as pytest may be, has its children ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if asked["session"]:
        os.setsid()
    for end, number in ((out, 1), (err, 2)):
        os.dup2(end, number)
        os.close(end)
    return asked


_KEPT: list[Any] = []


def _open_outputs() -> None:
    """Standard output and error anew: the nursery's own may have been of another kind."""
    _KEPT.extend([sys.stdout, sys.stderr])  # their end would close the numbers 1 and 2
    sys.stdout = io.TextIOWrapper(io.BufferedWriter(io.FileIO(1, "w", closefd=False)), "utf-8")
    sys.stderr = io.TextIOWrapper(
        io.BufferedWriter(io.FileIO(2, "w", closefd=False)),
        "utf-8",
        "backslashreplace",
        line_buffering=True,
    )
    sys.__stdout__, sys.__stderr__ = sys.stdout, sys.stderr


def _become(asked: dict[str, Any]) -> None:
    """Run the module, or the code, as a new interpreter would."""
    import runpy

    _open_outputs()
    os.environ.clear()
    os.environ.update(asked["env"])
    os.chdir(asked["cwd"])
    added = [path for path in asked["env"].get("PYTHONPATH", "").split(os.pathsep) if path]
    module = asked["kind"] == "-m"
    first = asked["cwd"] if module else ""
    sys.path[:] = [first, *added, *(path for path in sys.path[1:] if path not in added)]
    if str(COARSE) in added:
        import sitecustomize

        from styleexp.inputs import shapes

        sitecustomize.coarsen(shapes)
    sys.argv[:] = [asked["kind"], *asked["arguments"]]
    if module:
        sys.modules.pop(asked["what"], None)  # runpy warns of what was loaded under its own name
        runpy.run_module(asked["what"], run_name="__main__", alter_sys=True)
        return
    main = types.ModuleType("__main__")
    sys.modules["__main__"] = main
    exec(compile(asked["what"], "<string>", "exec"), main.__dict__)


if __name__ == "__main__":
    _load()
    _become(_serve(socket.socket(fileno=int(sys.argv[1]))))
