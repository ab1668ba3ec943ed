"""The server: local unless a token is given, and closed to pages of other origins."""

from __future__ import annotations

import fcntl
import hmac
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from parallel_cal.base.worker import Worker
from parallel_cal.session.history import SessionError
from parallel_cal.workbench.bench import Bench, Live

# A window may be silent this long: drawing in 3D without a graphics card takes seconds.
RECONNECT_TIMEOUT_S = 60.0
SERVED = ".served"  # locked by the server of a session; contains its process and its address
LOOPBACK = ("127.0.0.1", "localhost", "::1")


@contextmanager
def hold_session(folder: Path, address: str) -> Iterator[None]:
    """Keep other servers from a session; SessionError if one at another address serves it.

    Two servers lose no step, but each would undo the steps of the other, and refuse its own after
    minutes of work because the session has changed. The system ends the lock with the process.
    """
    try:
        file = (folder / SERVED).open("a+", encoding="utf-8")
    except OSError:  # nobody can change a session in this folder
        yield
        return
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise SessionError(
                f"{folder}: {file.read() or 'another process'} serves this session already: open "
                "that page, or stop that process first"
            ) from None
        file.truncate(0)
        file.write(f"process {os.getpid()} at {address}")
        file.flush()
        yield


class Guard:
    """An ASGI filter: refuse a foreign Host or Origin, and requests without the token.

    The token comes once as `?token=...`. A cookie then keeps it, so that it can leave the URL.
    """

    def __init__(self, app: Any, hosts: tuple[str, ...], token: str = ""):
        self.app, self.hosts, self.token = app, hosts, token

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] not in ("http", "websocket"):
            return await self.app(scope, receive, send)
        headers = {k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}
        asked = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if not self._is_known_host(f"//{headers.get('host', '')}") or (
            "origin" in headers and not self._is_known_host(headers["origin"])
        ):
            return await self._refuse(
                scope, send, b"foreign Host or Origin: use the printed address"
            )
        if self.token and not self._is_allowed(asked, headers.get("cookie", "")):
            return await self._refuse(scope, send, b"token missing or wrong: open the printed link")

        async def with_cookie(message: Any) -> None:
            if message["type"] == "http.response.start" and self.token and asked:
                cookie = f"token={self.token}; HttpOnly; SameSite=Strict; Path=/"
                message["headers"] = [*message["headers"], (b"set-cookie", cookie.encode())]
            await send(message)

        await self.app(scope, receive, with_cookie)

    def _is_known_host(self, url: str) -> bool:
        return urlsplit(url).hostname in self.hosts

    def _is_allowed(self, asked: str, cookies: str) -> bool:
        given = [asked, *(c.partition("=")[2] for c in cookies.split("; ") if c[:6] == "token=")]
        return any(hmac.compare_digest(one, self.token) for one in given)

    async def _refuse(self, scope: Any, send: Any, why: bytes) -> None:
        if scope["type"] == "websocket":
            return await send({"type": "websocket.close", "code": 1008})
        head = [(b"content-type", b"text/plain")]
        await send({"type": "http.response.start", "status": 403, "headers": head})
        await send({"type": "http.response.body", "body": why})


def serve(
    folder: Path,
    output: Path | None = None,
    live: Live | None = None,
    *,
    worker: Worker | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    token: str = "",
    show: bool = True,
) -> None:
    """Serve the session in `folder` until the process ends.

    Save writes `output`; `live` are the nodes at the robot. `worker` is as in `Bench`.
    """
    bench = Bench(folder, output, live, worker)  # its worker starts while NiceGUI is imported
    from nicegui import app, run, ui

    from parallel_cal.workbench.page import build

    run.process_pool_start_method = "spawn"  # forks of a process with threads may hang
    # The server ends its process by the signal that it received, so `finally` would not run.
    app.on_shutdown(bench.close)
    build(bench)
    app.add_middleware(Guard, hosts=(*LOOPBACK, host), token=token)
    ui.run(
        host=host,
        port=port,
        show=show,
        reload=False,
        title="parallel-cal",
        favicon="📐",
        show_welcome_message=False,
        dark=None,
        tailwind=False,
        reconnect_timeout=RECONNECT_TIMEOUT_S,
        uvicorn_logging_level="warning",
    )
