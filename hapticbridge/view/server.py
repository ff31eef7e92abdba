"""Server of viser's page, with a check of host, origin and token before every request."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import io
import logging
import secrets
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import viser
import viser._gui_handles
import viser._messages
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from hapticbridge.errors import HapticBridgeError
from hapticbridge.files import install_command
from hapticbridge.view.window import HOST, Address

Process = Callable[[Any, Request], Response | Awaitable[Response | None] | None]

MAX_MESSAGE = 1 << 16
"""Largest message from a browser in bytes. Button presses and camera poses have some hundred."""

_SERVING = threading.Lock()


def serve(address: Address) -> viser.ViserServer:
    """Starts viser's server with a check before every request, of pages and of sockets.

    Raises:
        HapticBridgeError: The port is in use, or this version of viser skips the check.
    """
    with _SERVING, _behind(address), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=HOST, port=address.port, verbose=False)
    # viser would take the next free port instead
    if address.port and server.get_port() != address.port:
        stop(server)
        raise HapticBridgeError(f"port {address.port} is in use; choose another one")
    if not _is_guarded(server.get_port(), address):
        stop(server)
        raise HapticBridgeError(
            f"viser {viser.__version__} skips the check of the token or has unknown scripts: "
            f"'{install_command('view')}' installs one that does not"
        )
    # viser would forward the page to its server on the internet at a browser's request, and keep
    # files that a browser sends
    for name in ("ShareUrlRequest", "ShareUrlDisconnect", "FileTransferStartUpload"):
        server._websock_server.unregister_handler(getattr(viser._messages, name))
    _take_values_alone(server)
    # viser would read any file of this user that an image in a text names
    viser._gui_handles._parse_markdown = lambda text, _: text
    server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    return server


def stop(server: viser.ViserServer) -> None:
    """Stops serving."""
    # viser prints this in the middle of our answers
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _take_values_alone(server: viser.ViserServer) -> None:
    """Lets a browser change the value of an element, and no other attribute.

    viser sets any attribute of its handle that a message names. ``removed`` would remove the stop
    button from all pages; ``props`` would end this process.
    """
    kind, take = viser._messages.GuiUpdateMessage, server.gui._handle_gui_updates

    async def take_value(client_id: Any, message: Any) -> None:
        if list(message.updates) == ["value"]:
            await take(client_id, message)

    server._websock_server.unregister_handler(kind)
    server._websock_server.register_handler(kind, take_value)


def _is_guarded(port: int, address: Address) -> bool:
    """Checks that a stranger is refused and a visitor gets the page; viser has no hook for both."""
    cookie = address.cookie(f"{HOST}:{port}").partition(";")[0]
    foreign = {"Host": "stranger.invalid", "Cookie": cookie}
    for headers, status in (({}, 403), (foreign, 403), ({"Cookie": cookie}, 200)):
        knock = http.client.HTTPConnection(HOST, port, timeout=10.0)
        try:
            knock.request("GET", "/", headers=headers)
            if knock.getresponse().status != status:
                return False
        except OSError:
            return False
        finally:
            knock.close()
    return True


@contextlib.contextmanager
def _behind(address: Address) -> Iterator[None]:
    """Inserts the check before every response; viser has no hook for it."""
    module: Any = websockets.asyncio.server
    plain = module.serve

    def guarded(*args: Any, process_request: Process | None = None, **options: Any) -> Any:
        options["max_size"] = MAX_MESSAGE
        door = _door(address, process_request)
        return plain(*args, process_request=door, **options)

    # viser looks the name up in its server's thread, which runs once ViserServer() returns
    module.serve = guarded
    # neither refusals nor messages that viser cannot read are errors to report
    for name in ("websockets.server", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        module.serve = plain


def _door(address: Address, inner: Process | None) -> Process:
    async def ask(connection: Any, request: Request) -> Response | None:
        # a repeated header could hide one value behind another
        headers = {name.lower(): request.headers.get_all(name) for name in request.headers}
        repeated = any(len(headers.get(name, [])) > 1 for name in ("host", "origin", "cookie"))
        first = {name: values[0] for name, values in headers.items()}
        reason = "a header is repeated" if repeated else address.refusal(request.path, first)
        if reason:
            return _plain(403, "Forbidden", f"hapticbridge: {reason}\n")
        host = first["host"]
        if address.is_in_query(request.path):
            # neither the history nor the address line keeps the token
            onward = _plain(303, "See Other", "")
            onward.headers["Location"] = "/"
            onward.headers["Set-Cookie"] = address.cookie(host)
            return onward
        request.headers.pop("Accept-Encoding", None)  # the page is changed below
        answer: Any = None if inner is None else inner(connection, request)
        if asyncio.iscoroutine(answer):
            answer = await answer
        if not isinstance(answer, Response):
            return None
        is_page = answer.headers.get("Content-Type", "").startswith("text/html")
        return _protected(answer, host) if is_page else _private(answer, "default-src 'none'")

    return ask


_POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}' 'wasm-unsafe-eval'; worker-src blob:; "
    "connect-src 'self' ws://{host} data: blob:; img-src data: blob:; font-src data:; "
    "style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page: viser's own scripts by a number used once, and no address
but its own. Viser would otherwise connect to any server that a link names (``?websocket=``). Its
sorter of Gaussian splats, which the view does not draw, may not evaluate text and stays away."""

_SCRIPTS = (
    ("<script ", '<script nonce="{nonce}" '),
    ('e.type="module";', 'e.type="module";e.nonce="{nonce}";'),
)
"""Places in viser's page that make a script, and what stands there instead."""


_LOADING = (
    '<div id="root"></div>',
    '<div id="root"><p style="font:16px sans-serif;margin:2em">Loading the scene …</p></div>',
)
"""Place of viser's page that its scripts fill, and what stands there until they are loaded."""


def _protected(response: Response, host: str) -> Response:
    """Lets a page run viser's scripts alone, and connect to its own host alone."""
    nonce, page = secrets.token_urlsafe(18), response.body.decode().replace(*_LOADING)
    for place, named in _SCRIPTS:
        if page.count(place) != 1:
            return _plain(500, "Unknown Page", "hapticbridge: this viser has unknown scripts\n")
        page = page.replace(place, named.format(nonce=nonce))
    response.body = page.encode()
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
    return _private(response, _POLICY.format(nonce=nonce, host=host))


def _plain(status: int, phrase: str, text: str) -> Response:
    body = text.encode()
    headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Connection": "close"})
    headers["Content-Length"] = str(len(body))
    return _private(Response(status, phrase, headers, body), "default-src 'none'")


def _private(response: Response, policy: str) -> Response:
    """Adds the headers against framing, leaking the address, guessing types and keeping copies."""
    response.headers.update(
        {
            "Content-Security-Policy": policy,
            "X-Frame-Options": "DENY",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cache-Control": "no-store",
        }
    )
    return response
