"""Discovery of Haply's devices in the maker's service."""

from __future__ import annotations

from collections.abc import Mapping

from hapticbridge.device.data_sheet import checked_number, stated_numbers
from hapticbridge.device.haply import messages
from hapticbridge.device.haply.driver import FIRST_ANSWER, FORCE_LIMIT, HaplyDevice
from hapticbridge.device.haply.messages import SERVICE, Listed
from hapticbridge.device.plugged import Family, Plugged, Tell, chosen
from hapticbridge.device.transport.hex_log import HexLog
from hapticbridge.device.transport.websocket import EXTRA, Link, WebSocketLink, websocket_client
from hapticbridge.errors import DeviceError

PLACE = ("localhost", 10001)
"""Default host and port of the service."""

_NUMBERS = ("mass", "damping", "friction", "resolution", "force_limit")


def open_haply(options: Mapping[str, object], tell: Tell) -> HaplyDevice:
    """Connects to the service and opens one of its devices.

    The options are ``service`` (HOST:PORT), ``serial`` (the service's device_id), ``force_gate``,
    ``log`` (a file for the messages), and numbers of the data sheet.

    Raises:
        DeviceError: The service does not run, lists no such device, or an option is not valid.
        DeviceLost: The service is gone.
    """
    host, port = _place(options.get("service"))
    link = WebSocketLink.open(host, port, SERVICE, HexLog.asked(options))
    return opened(link, options, tell)


def opened(link: Link, options: Mapping[str, object], tell: Tell) -> HaplyDevice:
    """Opens a device of a connected service; arguments as for ``open_haply``."""
    try:
        numbers = stated_numbers(options, _NUMBERS)
        force_gate = checked_number("force_gate", options.get("force_gate", 0.0), "")
        devices = _devices(link)
        serial = chosen(FAMILY, [_plugged(d) for d in devices], options.get("serial")).serial
        listed = next(device for device in devices if device.device_id == serial)
    except BaseException:
        link.close()
        raise
    return HaplyDevice(link, listed, force_gate=force_gate, numbers=numbers, tell=tell)


def find(place: tuple[str, int] = PLACE) -> list[Plugged]:
    """Lists the devices of the service; empty if it does not run."""
    try:
        link = WebSocketLink.open(*place, SERVICE, HexLog(""))
    except DeviceError:
        return []
    try:
        return [_plugged(device) for device in _devices(link)]
    except DeviceError:
        return []
    finally:
        link.close()


def medium(place: tuple[str, int] = PLACE) -> str:
    """Returns a sentence on whether the service runs."""
    if websocket_client() is None:
        return EXTRA
    try:
        WebSocketLink.open(*place, SERVICE, HexLog("")).close()
    except DeviceError as error:
        return f"{error}"
    return f"{SERVICE} runs at {place[0]}:{place[1]}"


def _devices(link: Link) -> list[Listed]:
    message = link.wait(FIRST_ANSWER)
    if message is None:
        raise DeviceError(f"{SERVICE} sent no list of devices within {FIRST_ANSWER:g} s")
    return messages.inventory(message)


def _plugged(device: Listed) -> Plugged:
    return Plugged(
        family="haply",
        name=device.kind,
        serial=device.device_id,
        path=SERVICE,
        vendor=0,
        product=0,
        transport="service",
        problem=None,
    )


def _place(service: object) -> tuple[str, int]:
    """Returns host and port of HOST:PORT; both are optional."""
    if service is None:
        return PLACE
    host, _, port = str(service).rpartition(":") if ":" in str(service) else (service, "", PLACE[1])
    try:
        number = int(port)
    except ValueError:
        number = 0
    if not 0 < number < 65536:
        raise DeviceError(f"service = '{service}': must be HOST:PORT, port 1 to 65535")
    return str(host) or PLACE[0], number


FAMILY = Family(
    name="haply",
    about="Haply Inverse3, Inverse3x and Minverse through the maker's Inverse Service",
    ids=(),
    transport="service",
    axes="x, y, z",
    force=f"{FORCE_LIMIT:g} N, or more with force_limit",
    rate="1 kHz",
    on_stall="the maker's service ends the force; the time until then is not documented",
    options=("service", "serial", "force_gate", *_NUMBERS, "log"),
    open=open_haply,
    find=find,
    medium=medium,
    sought="a device of the Inverse Service",
)
