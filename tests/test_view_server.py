"""Server of a page: it answers its own page alone."""

from __future__ import annotations

import contextlib
import http.client
import socket
import time
from collections.abc import Iterator
from email.message import Message
from typing import Any

import pytest

from hapticbridge.view.window import Address

pytest.importorskip("viser", reason="needs the extra 'view'")

import websockets.exceptions
from page_client import hand
from waiting import PATIENCE
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from hapticbridge.view.server import serve, stop

# viser's threads and sockets end with the process
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


def answer(
    host: str, port: int, path: str = "/", method: str = "GET", **headers: str
) -> tuple[int, Message, str]:
    """Returns status, headers and body of a request."""
    client = http.client.HTTPConnection(host, port, timeout=20)
    with contextlib.closing(client):
        client.request(method, path, headers=headers)
        got = client.getresponse()
        return got.status, got.headers, got.read().decode("utf-8", "ignore")


def is_let_in(host: str, port: int, path: str = "/", **options: Any) -> bool:
    try:
        with connect(
            f"ws://{host}:{port}{path}", subprotocols=[Subprotocol("viser-v0")], **options
        ):
            return True
    except websockets.exceptions.InvalidStatus as refused:
        assert refused.response.status_code == 403
        return False


@pytest.fixture
def served() -> Iterator[tuple[Address, int]]:
    address = Address(0)
    server = serve(address)
    yield address, server.get_port()
    stop(server)


def test_the_server_answers_its_own_page_alone(served: tuple[Address, int]) -> None:
    (address, port), host = served, "127.0.0.1"
    kept, wrong = f"hapticbridge_{port}={address.token}", f"hapticbridge_{port}=wrong"
    # path, headers, status of a page; a socket is answered where the page is
    requests: list[tuple[str, dict[str, str], int]] = [
        ("/", {}, 403),
        ("/", {"Cookie": kept}, 200),
        ("/", {"Cookie": wrong}, 403),
        ("/", {"Cookie": kept, "Host": "evil.example"}, 403),
        ("/", {"Cookie": kept, "Origin": "http://evil.example"}, 403),
        ("/?token=wrong", {}, 403),
        (f"/?token={address.token}", {}, 303),
        (f"/?token={address.token}", {"Host": "evil.example"}, 403),
        (f"/?token={address.token}", {"Origin": "http://evil.example"}, 403),
    ]
    for path, headers, status in requests:
        assert answer(host, port, path, **headers)[0] == status
        # a second Host beside the right one, as a careless proxy might read it
        assert is_let_in(host, port, path, additional_headers=headers) is (status == 200)
    cookie = {"Cookie": kept}
    assert is_let_in(host, port, origin=f"http://{host}:{port}", additional_headers=cookie)
    with socket.socket() as probe, pytest.raises(OSError, match="refused"):
        probe.connect(("127.0.0.2", port))  # served on loopback's first address alone


def test_the_address_carries_the_token_once_and_a_cookie_keeps_it(
    served: tuple[Address, int],
) -> None:
    (address, port), host = served, "127.0.0.1"
    secret = f"/?token={address.token}"
    assert address.url(port) == f"http://{host}:{port}{secret}"
    for asked in (
        secret,
        f"//evil.example/{secret}",
        f"/x?websocket=ws://evil.example&{secret[2:]}",
    ):
        _, headers, body = answer(host, port, asked)
        assert (headers["Location"], body) == ("/", "")
        assert headers["Set-Cookie"] == (
            f"hapticbridge_{port}={address.token}; Path=/; HttpOnly; SameSite=Strict"
        )
    assert answer(host, port)[1]["Set-Cookie"] is None
    # through a tunnel from another port, which gets a cookie of its own
    _, headers, _ = answer(host, port, secret, Host="localhost:9000")
    assert f"hapticbridge_9000={address.token}" in headers["Set-Cookie"]


def test_every_answer_forbids_frames_foreign_scripts_and_addresses(
    served: tuple[Address, int],
) -> None:
    address, port = served
    cookie = address.cookie(f"127.0.0.1:{port}").partition(";")[0]
    nonces = set()
    for path, headers in (
        ("/", {}),
        (f"/?token={address.token}", {}),
        ("/", {"Cookie": cookie}),
        ("/", {"Cookie": cookie, "Accept-Encoding": "gzip"}),
        ("/none", {"Cookie": cookie}),
    ):
        status, told, body = answer("127.0.0.1", port, path, **headers)
        assert told["X-Frame-Options"] == "DENY"
        assert told["Referrer-Policy"] == "no-referrer"
        assert told["Cache-Control"] == "no-store"
        policy = dict(part.split(" ", 1) for part in told["Content-Security-Policy"].split("; "))
        assert policy["default-src"] == "'none'"
        if status == 200:
            nonce = policy["script-src"].split("'")[1].removeprefix("nonce-")
            nonces.add(nonce)
            assert body.count(nonce) == 2
            assert "Loading the scene" in body  # until viser's scripts draw the page
            assert policy["script-src"] == f"'nonce-{nonce}' 'wasm-unsafe-eval'"
            assert policy["connect-src"] == f"'self' ws://127.0.0.1:{port} data: blob:"
            assert policy["frame-ancestors"] == policy["base-uri"] == "'none'"
    assert len(nonces) == 2


def test_visers_way_out_to_the_internet_and_its_store_of_files_are_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    address, asked = Address(0), list[str]()
    server = serve(address)
    for name in ("request_share_url", "disconnect_share_url"):
        monkeypatch.setattr(server, name, lambda name=name: asked.append(name))
    box, upload = server.gui.add_checkbox("box", False), server.gui.add_upload_button("upload")
    try:
        with hand(address.url(server.get_port())) as page:
            page.find("upload")
            file = {"filename": "a", "mime_type": "", "part_count": 0, "size_bytes": 0}
            page.say(type="ShareUrlRequest")
            page.say(type="ShareUrlDisconnect")
            place = {"source_component_uuid": page.find("upload")["uuid"], "transfer_uuid": "b"}
            page.say(type="FileTransferStartUpload", **place, **file)
            page.send("box", value=True)  # heard after all that
            end = time.monotonic() + PATIENCE
            while not box.value:
                assert time.monotonic() < end
                assert "FileTransferPartAck" not in {each["type"] for each in page.read(0.05)}
            assert "FileTransferPartAck" not in {each["type"] for each in page.read(0.05)}
        assert (asked, upload.value.content) == ([], b"")
    finally:
        stop(server)
