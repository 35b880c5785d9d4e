"""The studio's server: a page, and what it asks for, to a browser on this machine alone.

Every address starts with a token that only the terminal shows, requests for other hosts than this
machine are refused (protection against DNS rebinding), and the page runs no script but its own.
"""

from __future__ import annotations

import functools
import secrets
import socket
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.cli.studio.settings import Settings
from styleexp.cli.studio.workbench import LARGEST, Workbench, too_large
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

HOST = "127.0.0.1"
WAIT = 20.0
"""Seconds after which a request for the state is answered although nothing has changed."""


def application(bench: Workbench, token: str) -> Starlette:
    """The pages of a workbench, below ``/TOKEN/``."""
    from starlette.applications import Starlette
    from starlette.concurrency import run_in_threadpool
    from starlette.middleware import Middleware
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response
    from starlette.routing import Mount, Route

    saved: dict[str, Path] = {}

    def page(request: Request) -> Response:
        return HTMLResponse(_page(), headers={"Referrer-Policy": "no-referrer"})

    def state(request: Request) -> Response:
        since = request.query_params.get("since", "-1")
        number = int(since) if since.isdecimal() else -1
        return JSONResponse(bench.state(number, WAIT), headers={"Cache-Control": "no-store"})

    def look(request: Request) -> Response:
        found = bench.look(request.path_params["name"])
        if found is None:
            return Response(status_code=404)
        return Response(found.content, headers={"Cache-Control": "no-store"})

    def asked(act: Callable[[Any], Any]) -> Callable[[Request], Any]:
        """An endpoint that acts on a JSON object; a `UserError` is a sentence for the page."""

        @functools.wraps(act)
        async def endpoint(request: Request) -> Response:
            try:
                given = await request.json()
            except ValueError:
                return JSONResponse({"error": "this is not JSON."}, 400)
            if not isinstance(given, dict):
                return JSONResponse({"error": "give an object."}, 400)
            return await answered(act, given)

        return endpoint

    async def answered(act: Callable[..., Any], *arguments: Any) -> Response:
        try:
            return JSONResponse(await run_in_threadpool(act, *arguments) or {})
        except UserError as error:
            return JSONResponse({"error": str(error)}, 422)
        except OSError as error:
            return JSONResponse(
                {"error": f"a file can't be written: {error.strerror or error}."}, 422
            )

    async def receive(request: Request) -> Response:
        parts, size = [], 0
        async for part in request.stream():
            size += len(part)
            if size > LARGEST:
                return JSONResponse({"error": too_large("the file")}, 413)
            parts.append(part)
        kind, name = request.path_params["kind"], request.path_params["name"]
        return await answered(bench.receive, kind, name, b"".join(parts))

    def save(given: dict[str, Any]) -> dict[str, Any]:
        formats = given.get("formats")
        if not isinstance(formats, list) or not formats:
            raise UserError("choose at least one format to save.")
        written = bench.save([str(each) for each in formats])
        saved.update({path.name: path for path in written})
        return {"files": [{"name": path.name, "path": str(path)} for path in written]}

    def download(request: Request) -> Response:
        path = saved.get(request.path_params["name"])
        if path is None or not path.is_file():
            return Response(status_code=404)
        return FileResponse(path, filename=path.name)

    routes = [
        Route("/", page),
        Route("/state", state),
        Route("/look/{name}", look),
        Route("/settings", asked(bench.change), methods=["POST"]),
        Route("/learn", asked(lambda given: bench.learn()), methods=["POST"]),
        Route("/stop", asked(lambda given: bench.stop()), methods=["POST"]),
        Route("/save", asked(save), methods=["POST"]),
        Route("/saved/{name}", download),
        Route("/files/{kind}/{name}", receive, methods=["PUT"]),
    ]
    hosts = Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])
    return Starlette(routes=[Mount(f"/{token}", routes=routes)], middleware=[hosts])


@functools.cache
def _page() -> str:
    """The page, with its script, style and 3D viewer in it."""
    from styleexp.experiments.reports import html
    from styleexp.inputs import shapes

    return html.render(
        "studio.html",
        ["viewers.js", "studio.js"],
        viewer=html.viewer(),
        blocks={},
        sources=[*shapes.SOURCES, *_here("mesh")],
        styles=[*shapes.STYLES, *_here("image")],
    )


def _here(kind: str) -> list[str]:
    """Names of meshes or pictures that are on this machine."""
    from styleexp.inputs import assets

    return [name for name in assets.names(kind) if assets.locate(name, kind) is not None]


def serve(settings: Settings, folder: Path, port: int, opens: bool) -> int:
    """Serve the studio until Ctrl-C; return the exit code. ``port`` 0 takes a free one.

    Raises `UserError` if the port is taken.
    """
    import uvicorn

    token = secrets.token_urlsafe(16)
    with socket.socket() as listening:
        try:
            listening.bind((HOST, port))
            listening.listen()  # so that who is quick waits, and isn't refused
        except OSError as error:
            raise UserError(
                f"--port {port} can't be used ({error.strerror}): leave it out for a free one."
            ) from None
        address = f"http://{HOST}:{listening.getsockname()[1]}/{token}/"
        bench = Workbench(settings, folder)
        bench.start()
        print(f"the studio: {address}\nfiles: {folder}\nCtrl-C ends it", flush=True)
        if opens:
            webbrowser.open(address)
        options = uvicorn.Config(
            application(bench, token), log_level="warning", access_log=False, lifespan="off",
            timeout_graceful_shutdown=1,
        )  # fmt: skip
        server = uvicorn.Server(options)
        ends = server.handle_exit

        def handle_exit(*signal: Any) -> None:
            bench.close()  # else requests that wait for news would be waited for
            ends(*signal)

        server.handle_exit = handle_exit  # type: ignore[assignment]
        with suppress(KeyboardInterrupt):
            server.run(sockets=[listening])
    return 0
