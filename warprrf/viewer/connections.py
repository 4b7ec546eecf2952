"""Who may connect to the page, and what a page may say.

A web page from anywhere can connect to a server on its reader's machine. Browsers tell which page asks (``Origin``) and for
whom (``Host``): the two must be the same, and where the server listens on this machine alone, ``Host`` must be a name of it.
A server for other machines asks for a token besides, the first part of the address that it prints.

Every message is checked against the types that viser's page sends before viser reads it. What is none of them is dropped and
reported: viser would keep a position of ``{"a": 1}``, and send it to all other pages.
"""

from __future__ import annotations

import hmac
import http
import io
import ipaddress
import operator
import secrets
import socket
import threading
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from functools import reduce
from typing import Annotated, Any, Literal, TypeAlias
from unittest.mock import patch
from urllib.parse import urlsplit

import msgspec
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from warprrf.device import require

Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]  # which no NaN is
Text = Annotated[str, msgspec.Meta(max_length=1000)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**31)]
Pair: TypeAlias = tuple[Number, Number]
Point: TypeAlias = tuple[Number, Number, Number]
Turn: TypeAlias = tuple[Number, Number, Number, Number]

SENT: dict[str, dict[str, Any]] = {
    "ViewerCameraMessage": {
        "wxyz": Turn, "position": Point, "look_at": Point, "up_direction": Point, "fov": Number, "near": Number,
        "far": Number, "image_height": Count, "image_width": Count,
    },
    "TransformControlsUpdateMessage": {"name": Text, "owner": Text, "wxyz": Turn, "position": Point},
    "TransformControlsDragStartMessage": {"name": Text, "owner": Text},
    "TransformControlsDragEndMessage": {"name": Text, "owner": Text},
    "SceneNodeClickMessage": {
        "name": Text, "owner": Text, "instance_index": Count | None, "ray_origin": Point, "ray_direction": Point,
        "screen_pos": Pair, "modifier": Text | None,
    },
    "ScenePointerMessage": {
        "event_type": Literal["click"], "ray_origin": Point, "ray_direction": Point, "screen_pos": tuple[Pair],
        "modifier": Text | None,
    },
    "GuiUpdateMessage": {"uuid": Text, "updates": dict[Literal["value"], bool | Number | Text]},
    "GetRenderResponseMessage": {"payload": bytes, "render_uuid": Text},
    "FileTransferStartUpload": {
        "source_component_uuid": Text, "transfer_uuid": Text, "filename": Text, "mime_type": Text,
        "part_count": Annotated[int, msgspec.Meta(ge=0, le=100)], "size_bytes": Annotated[int, msgspec.Meta(ge=0, le=2**24)],
    },
    "FileTransferPart": {
        "source_component_uuid": Text, "transfer_uuid": Text, "part_index": Count,
        "content": Annotated[bytes, msgspec.Meta(max_length=2**20)],
    },
}  # fmt: skip
"""Messages of viser's page as far as this viewer uses them, and the types of their fields."""

_READ = msgspec.msgpack.Decoder(
    reduce(
        operator.or_,
        [
            msgspec.defstruct(
                name, [(key, kind, "") if key == "owner" else (key, kind) for key, kind in fields.items()],
                tag=name, tag_field="type", kw_only=True, forbid_unknown_fields=True,
            )
            for name, fields in SENT.items()
        ],
    )
)  # fmt: skip
_STARTING = threading.Lock()


def open_server(host: str, port: int, refused: Callable[[str], None]) -> tuple[Any, str]:
    """A ``viser.ViserServer`` behind these checks, and the address of its page.

    viser asks nobody about requests and messages, so that the arguments which websockets has for both are added where viser
    calls it, while the server starts.

    Args:
        host, port: where it listens; the next free port if it is taken.
        refused: called with what is wrong with a message.
    """
    viser, serve = require("viser", extra="view"), websockets.asyncio.server.serve
    token = "" if _is_this_machine(host) else secrets.token_urlsafe(16)

    class Checked(ServerConnection):
        async def recv(self, decode: bool | None = None) -> Any:
            while True:
                message = await super().recv(decode)
                try:
                    if isinstance(message, str):
                        raise TypeError("Expected bytes, got text")
                    _READ.decode(message)
                except (msgspec.MsgspecError, RecursionError, TypeError) as error:
                    refused(str(error))
                else:
                    return message

    def watched(handler: Any, *address: Any, process_request: Any, **options: Any) -> Any:
        def asked(connection: ServerConnection, request: Request) -> Response | None:
            wrong = _refusal(request, token)
            if wrong is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{wrong}\n")
            return process_request(connection, replace(request, path=request.path.removeprefix(f"/{token}")))

        return serve(handler, *address, process_request=asked, create_connection=Checked, **options)

    with (
        _STARTING,
        patch.object(websockets.asyncio.server, "serve", watched),
        redirect_stdout(io.StringIO()),  # viser prints where it is
    ):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    name = socket.gethostname() if host == "0.0.0.0" else host
    return server, f"http://{name}:{server.get_port()}" + (f"/{token}/" if token else "")


def _refusal(request: Request, token: str) -> str | None:
    """Why a request is refused; None if it is not."""
    host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
    said = request.path.partition("?")[0].lstrip("/").partition("/")[0]
    if token and not hmac.compare_digest(said.encode(), token.encode()):
        return "token: not that of this server, open the whole address that it printed"
    if not token and not _is_this_machine(urlsplit(f"//{host}").hostname or ""):
        return f"Host: got {host!r}, expected a name of this machine, such as localhost"
    socket_asked = request.headers.get("Upgrade") is not None
    if (socket_asked or origin is not None) and (origin or "").partition("://")[2] != host:
        return f"Origin: got {origin!r}, expected a page of {host}"
    return None


def _is_this_machine(name: str) -> bool:
    try:
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False
