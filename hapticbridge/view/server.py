"""Server of viser's page, with a check of host, origin and token before every request."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import io
import logging
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import viser
import viser._messages
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from hapticbridge.errors import HapticBridgeError
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
        raise HapticBridgeError(f"port {address.port} is in use; choose another with --port")
    if not _is_guarded(server.get_port()):
        stop(server)
        raise HapticBridgeError("this version of viser skips the check of the token")
    # viser would forward the page to its server on the internet at a browser's request, and keep
    # files that a browser sends
    for name in ("ShareUrlRequest", "ShareUrlDisconnect", "FileTransferStartUpload"):
        server._websock_server.unregister_handler(getattr(viser._messages, name))
    _take_values_alone(server)
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


def _is_guarded(port: int) -> bool:
    """Checks that a request with a foreign Host is refused; viser has no hook for the check."""
    knock = http.client.HTTPConnection(HOST, port, timeout=10.0)
    try:
        knock.request("GET", "/", headers={"Host": "stranger.invalid"})
        return knock.getresponse().status == http.HTTPStatus.FORBIDDEN
    except OSError:
        return False
    finally:
        knock.close()


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
            return _refused(reason)
        answer: Any = None if inner is None else inner(connection, request)
        if asyncio.iscoroutine(answer):
            answer = await answer
        if isinstance(answer, Response) and address.is_in_query(request.path):
            answer.headers["Set-Cookie"] = address.cookie(first["host"])
        return answer if isinstance(answer, Response) else None

    return ask


def _refused(reason: str) -> Response:
    body = f"hapticbridge: {reason}\n".encode()
    headers = Headers(
        {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
    )
    headers["Connection"] = "close"
    return Response(403, "Forbidden", headers, body)
