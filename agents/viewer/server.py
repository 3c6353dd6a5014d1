"""Serves the page to this machine's browser alone."""

import asyncio
import hmac
import os
import secrets
import socket
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fastapi.responses import PlainTextResponse
from nicegui import app, background_tasks, ui
from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.websockets import WebSocketClose

from agents.viewer.page import LARGEST_UPLOAD

HOST = "127.0.0.1"
#: Largest request: a file, and what a browser sends around it [byte].
_LARGEST_REQUEST = LARGEST_UPLOAD + 1_000_000
_COOKIE = "ae-env-view"


class TokenGuard:
    """Refuses every request without the token of this start.

    The printed address contains it, and a cookie keeps it. Requests to or from other names are
    refused, too: a foreign page may make its own name lead here, and whoever reaches the page can
    name a Python file as a policy.
    """

    def __init__(self, app: Any, token: str, port: int) -> None:
        self._app, self._token = app, token
        self._cookie = f"{_COOKIE}-{port}"  # cookies are shared between ports
        names = (HOST, "localhost")
        self._hosts = {f"{name}:{port}" for name in names} | (set(names) if port == 80 else set())

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Passes a request on, or refuses it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        asked = HTTPConnection(scope)
        origin = asked.headers.get("origin")
        own = asked.headers.get("host") in self._hosts
        own = own and (origin is None or origin.removeprefix("http://") in self._hosts)
        by_query = own and self._is_token(asked.query_params.get("token", ""))
        if not by_query and not (own and any(map(self._is_token, self._cookies(asked)))):
            text = "Open the address that ae-env printed: it contains the token."
            refusal: Any = PlainTextResponse(text, 403)
            if scope["type"] == "websocket":
                refusal = WebSocketClose(1008)
            await refusal(scope, receive, send)
            return

        taken = 0

        async def limited() -> Any:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            return message if taken <= _LARGEST_REQUEST else {"type": "http.disconnect"}

        async def with_cookie(message: Any) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["referrer-policy"] = "no-referrer"
                if by_query:
                    value = f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict"
                    headers.append("set-cookie", value)
            await send(message)

        await self._app(scope, limited if scope["type"] == "http" else receive, with_cookie)

    def _cookies(self, asked: HTTPConnection) -> list[str]:
        """Values of the cookie; other servers of this machine may set one of the same name."""
        header = ";".join(asked.headers.getlist("cookie"))
        pairs = (pair.strip().partition("=") for pair in header.split(";"))
        return [value for name, _, value in pairs if name == self._cookie]

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self._token.encode())


def free_port(port: int) -> int:
    """`port`, or any free one for 0; a `ValueError` if something listens there already."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            text = f"`port` (={port}) must be free: {error.strerror}; 0 takes any"
            raise ValueError(text) from None
        return int(probe.getsockname()[1])


def serve(title: str, show: Callable[[], Any], files: Any, port: int, open_browser: bool) -> None:
    """Serves a page at a free port until it is stopped, and prints the address then.

    `show` puts the page together, `files` is a folder for the program's own files.
    """
    token = secrets.token_urlsafe(16)
    path = f"/?token={token}"
    app.add_middleware(TokenGuard, token=token, port=port)
    address = f"http://{HOST}:{port}{path}"
    ui.page("/", title=title, dark=True, language="en-US")(show)
    # Uploads and downloads are gone with the program, however its pages were left.
    with files as folder:

        def served() -> None:
            print(f"open {address}\nCtrl-C stops", flush=True)
            if open_browser:
                webbrowser.open(_page_that_leads_to(address, Path(folder)))

        app.on_startup(lambda: background_tasks.create(_call_when_served(served, port)))
        how: dict[str, Any] = {"host": HOST, "port": port, "show": False}
        how |= {"show_welcome_message": False, "uvicorn_logging_level": "error"}
        ui.run(reload=False, reconnect_timeout=10.0, **how)


def _page_that_leads_to(address: str, folder: Path) -> str:
    """Address of a file that only this user may read; all may read a browser's arguments."""
    page = folder / "open.html"
    with open(os.open(page, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(f'<meta http-equiv="refresh" content="0;url={address}">')
    return page.as_uri()


async def _call_when_served(served: Callable[[], None], port: int) -> None:
    """Calls `served` as soon as the port answers: the program starts before it listens."""
    while True:
        try:
            _, writer = await asyncio.open_connection(HOST, port)
        except OSError:
            await asyncio.sleep(0.05)
            continue
        writer.close()
        served()
        return
