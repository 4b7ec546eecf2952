"""The page's real server: who may connect, and what it makes of messages that no page sends."""

import json
import math
import socket
import time
import urllib.error
import urllib.request
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
import viser
from golden import make
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import warprrf as wr

PLACE = make.TRANSMITTER + [2.0, 0.3, -1.0]
DRAG = {"type": "TransformControlsUpdateMessage", "name": "/receiver", "wxyz": [1, 0, 0, 0]}


@pytest.fixture(scope="module")
def viewer():
    viewer = wr.view(make.room_mesh()[0], port=8150)
    yield viewer
    viewer.close()


def client(viewer, origin="http://{host}", host=None, path=""):
    """A page of ``origin`` that asks the viewer's server for ``host``."""
    own = urlsplit(viewer.url)
    host = host or f"127.0.0.1:{own.port}"
    return connect(
        f"ws://{host}{path}", origin=origin and origin.format(host=host), max_size=None, max_queue=None,
        subprotocols=[f"viser-v{viser.__version__}"], sock=socket.create_connection(("127.0.0.1", own.port)),
    )  # fmt: skip


def refused(*args, **options):
    with pytest.raises(InvalidStatus) as found, client(*args, **options):
        pass
    return found.value.response.status_code == 403


def until(done):
    end = time.monotonic() + 20
    while not done() and time.monotonic() < end:
        time.sleep(0.01)
    return done()


def answered(viewer, page, x):
    """Whether a good drag of the receiver to ``x`` is answered there."""
    place = PLACE + [x, 0.0, 0.0]
    page.send(msgspec.msgpack.encode(DRAG | {"position": place.tolist()}))
    return until(lambda: viewer.last is not None and np.array_equal(viewer.last.receiver, place))


def test_pages_of_another_origin_are_refused(viewer):
    for host in (None, f"localhost:{urlsplit(viewer.url).port}"):
        with client(viewer, host=host) as page:
            assert answered(viewer, page, 0.1 if host else 0.0)
    for origin in ("http://elsewhere.example", "http://127.0.0.1:1", "null", None):
        assert refused(viewer, origin)
    assert refused(viewer, host="elsewhere.example:8150")  # a name that leads here, and a page of that name


def test_other_machines_need_the_token_of_the_printed_address():
    viewer = wr.view(make.room_mesh()[0], host="0.0.0.0", port=8170)
    try:
        path = urlsplit(viewer.url).path
        assert len(path) > 20 and path.endswith("/")
        with client(viewer, path=path[:-1]) as page:  # as the page asks from there
            assert answered(viewer, page, 0.0)
        here = f"http://127.0.0.1:{urlsplit(viewer.url).port}"
        assert b"<html" in urllib.request.urlopen(here + path).read()
        for wrong in ("/", "/wrong/", path[:-2], "/é"):
            assert refused(viewer, path=wrong.replace("é", "%C3%A9"))
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(here)
        assert refused(viewer, "http://elsewhere.example", path=path)
    finally:
        viewer.close()


WRONG = [{"a": 1}, {"a": {"b": [1]}}, None, True, "1,2,3", 3, [], [1, 2], [1, 2, "3"], [1, 2, None], [1, 2, math.nan],
         [1, 2, math.inf], [1, 2, 1e300], [1, 2, 10**18], [[1, 2, 3]] * 3]  # fmt: skip


def test_no_message_stops_the_answers(viewer):
    gui = {"type": "GuiUpdateMessage", "uuid": viewer._channel.carrier._handle._impl.uuid}
    array = gui | {"uuid": viewer._rays._array._handle._impl.uuid}
    messages = [DRAG | {"position": value} for value in WRONG]
    messages += [DRAG, DRAG | {"name": {}}, DRAG | {"position": [1, 2, 3], "more": 1}]
    messages += [{}, [], 5, None, {"type": 5}, {"type": "ShareUrlRequest"}, {"type": "NoSuchMessage"}]
    messages += [gui | {"updates": {"value": value}} for value in (*WRONG, 1e8, -1)]
    messages += [gui | {"updates": u} for u in (5, {"update_cb": 5}, {"min": 1})]
    messages += [array | {"updates": {"value": value}} for value in ("none such", 3)]
    raw = [msgspec.msgpack.encode(m) for m in messages] + [b"", b"\xc1", b"\x91" * 5000, bytes(1 << 20)]
    with client(viewer) as page, client(viewer) as beside:
        for k, data in enumerate([json.dumps(DRAG), *raw]):
            page.send(data)
            assert answered(viewer, page, 0.01 * k), data[:200]
        assert answered(viewer, beside, 0.0)  # what one page says harms no other
        page.send(raw[0])
        assert until(lambda: "Expected `array`, got `object` - at `$.position`" in viewer.message)


def test_what_fails_in_an_answer_is_said_and_the_next_is_answered(viewer, monkeypatch):
    seen = []
    with monkeypatch.context() as patched:
        patched.setattr("warprrf.viewer.answers.answer", lambda *_: {}["a bug"])
        patched.setattr("threading.excepthook", seen.append)
        viewer.refresh()
        assert viewer.wait(20) is None and "KeyError: 'a bug'" in viewer.message
        viewer._page.in_background(lambda progress: {}["another"])
        viewer._page.wait()
        assert "KeyError: 'another'" in viewer.message and len(seen) == 2
    viewer.refresh()
    assert viewer.wait(20) is not None
