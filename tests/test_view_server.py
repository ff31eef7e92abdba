"""Server of a page: it answers its own page alone."""

from __future__ import annotations

import contextlib
import http.client
import socket
import time
from typing import Any

import pytest

from hapticbridge.view.window import Address

pytest.importorskip("viser", reason="needs the extra 'view'")

import websockets.exceptions
from page_client import PATIENCE, hand
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from hapticbridge.view.server import serve, stop

# viser's threads and sockets end with the process
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


def answer(
    host: str, port: int, path: str = "/", method: str = "GET", **headers: str
) -> tuple[int, str, str]:
    """Returns status, cookie and body of a request."""
    client = http.client.HTTPConnection(host, port, timeout=20)
    with contextlib.closing(client):
        client.request(method, path, headers=headers)
        got = client.getresponse()
        return got.status, got.getheader("Set-Cookie") or "", got.read().decode("utf-8", "ignore")


def is_let_in(host: str, port: int, path: str = "/", **options: Any) -> bool:
    try:
        with connect(
            f"ws://{host}:{port}{path}", subprotocols=[Subprotocol("viser-v0")], **options
        ):
            return True
    except websockets.exceptions.InvalidStatus as refused:
        assert refused.response.status_code == 403
        return False


def test_the_server_answers_its_own_page_alone_and_a_browser_keeps_its_token(
    request: pytest.FixtureRequest,
) -> None:
    address, host = Address(0), "127.0.0.1"
    server = serve(address)
    request.addfinalizer(lambda: stop(server))
    port = server.get_port()
    secret, evil = f"/?token={address.token}", "http://evil.example"
    kept, wrong = f"hapticbridge_{port}={address.token}", f"hapticbridge_{port}=wrong"
    assert address.url(port) == f"http://{host}:{port}{secret}"
    # path, headers, whether it is answered
    requests: list[tuple[str, dict[str, str], bool]] = [
        (secret, {}, True),
        (secret, {"Host": "evil.example"}, False),
        (secret, {"Origin": evil}, False),
        ("/", {}, False),
        ("/?token=wrong", {}, False),
        ("/", {"Cookie": kept}, True),
        ("/", {"Cookie": wrong}, False),
    ]
    for path, headers, is_answered in requests:
        assert (answer(host, port, path, **headers)[0] == 200) is is_answered
        # a second Host beside the right one, as a careless proxy might read it
        options = {"additional_headers": headers}
        assert is_let_in(host, port, path, **options) is is_answered
    assert is_let_in(host, port, secret, origin=f"http://{host}:{port}")
    assert answer(host, port)[1] == ""
    _, cookie, _ = answer(host, port, secret)
    assert cookie == f"{kept}; Path=/; HttpOnly; SameSite=Strict"
    # through a tunnel from another port, which gets a cookie of its own
    _, cookie, _ = answer(host, port, secret, Host="localhost:9000")
    assert f"hapticbridge_9000={address.token}" in cookie
    with socket.socket() as probe, pytest.raises(OSError, match="refused"):
        probe.connect(("127.0.0.2", port))  # served on loopback's first address alone


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
