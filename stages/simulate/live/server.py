"""The local server of a live session, which serves the page and exchanges messages and frames over a WebSocket.

It listens on 127.0.0.1 only. The address has a random token; requests with another host, path or origin are refused.
The first client controls the session and others watch; when it leaves, the client connected longest takes over. A
client gets a new frame only after it has drawn the previous one, so that none falls behind. The server runs in a thread
of its own.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import secrets
import socket
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus

from stages.core.errors import InputError, MissingPackage
from stages.simulate.live.messages import MAX_BYTES, BadMessage, parse_message

log = logging.getLogger(__name__)
HOST = "127.0.0.1"
MAX_CLIENTS = 16
MAX_ERRORS = 10  # invalid messages after which a client is disconnected
MAX_RATE = 500  # most messages per second from a client; beyond, it is disconnected
MAX_WAITING = 1000  # most messages that wait for the engine; older ones are dropped
HANDSHAKE_TIME = 5.0  # time after which a connection without a request is closed [s]


@dataclass(eq=False)
class Client:
    """A connected page."""

    socket: object
    ready: bool = False  # has drawn the last frame that was sent to it
    sent: int = -1  # number of the last frame that was sent to it
    errors: int = 0  # invalid messages so far
    second: int = 0  # second of the clock to which `count` refers
    count: int = 0  # messages received in this second


class LiveServer:
    """Context manager that serves `page` at `url`.

    Raises InputError if it cannot listen on the port (0: any free one), and MissingPackage without websockets.
    """

    def __init__(self, page: str, port: int = 0):
        try:
            import websockets.asyncio.server  # noqa: F401 -- only live sessions need it
        except ImportError as error:
            raise MissingPackage("--live needs the package websockets: `pip install websockets`") from error
        self._page, self._token = page.encode(), secrets.token_urlsafe(24)
        try:
            self._listener = socket.create_server((HOST, port))
        except OSError as error:
            raise InputError(
                f"--port {port}: the port cannot be opened ({error.strerror}); choose another one"
            ) from error
        self.port = self._listener.getsockname()[1]
        self.url = f"http://{HOST}:{self.port}/{self._token}/"
        self._clients: list[Client] = []
        self._waiting: deque[dict] = deque(maxlen=MAX_WAITING)
        self._frame, self._number = b"", -1
        self._arrived = threading.Event()
        self._loop = asyncio.new_event_loop()
        # asyncio would print a traceback for connections beyond the limit of open files, which it accepts later
        self._loop.set_exception_handler(lambda _, context: log.debug("%s", context["message"]))
        self._thread = threading.Thread(target=self._run, name="live server", daemon=True)

    def __enter__(self) -> LiveServer:
        self._started = threading.Event()
        self._thread.start()
        self._started.wait(timeout=10)
        return self

    def __exit__(self, *_) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(timeout=5)

    def messages(self, wait: float = 0.0) -> list[dict]:
        """Messages of the controlling client since the last call; waits up to `wait` [s] for the first."""
        if wait:
            self._arrived.wait(wait)
        self._arrived.clear()
        return [self._waiting.popleft() for _ in range(len(self._waiting))]

    def publish(self, frame: bytes) -> None:
        """Send a frame to all clients that are ready; the others get the newest frame once they are ready."""
        self._loop.call_soon_threadsafe(self._publish, frame)

    # --- the methods below run in the thread of the server ---

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._serve())
        self._loop.close()

    async def _serve(self) -> None:
        from websockets.asyncio.server import serve

        quiet = logging.getLogger(f"{__name__}.websockets")  # failed handshakes are expected
        quiet.setLevel(logging.CRITICAL)
        self._stop = asyncio.Event()
        server = serve(
            self._talk, sock=self._listener, origins=[f"http://{HOST}:{self.port}"], process_request=self._answer,
            max_size=MAX_BYTES, max_queue=16, compression=None, open_timeout=HANDSHAKE_TIME, close_timeout=1,
            logger=quiet,
        )  # fmt: skip
        async with server:
            self._started.set()
            await self._stop.wait()

    def _answer(self, connection, request):
        """Response to an HTTP request: the page or an error; None to continue the handshake of a WebSocket."""
        from websockets.datastructures import Headers
        from websockets.http11 import Response

        path = request.path.encode("ascii", "replace")
        if request.headers.get_all("Host") != [f"{HOST}:{self.port}"]:
            return connection.respond(HTTPStatus.FORBIDDEN, "wrong host\n")
        if hmac.compare_digest(path, f"/{self._token}/live".encode()):
            full = len(self._clients) >= MAX_CLIENTS
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages\n") if full else None
        if not hmac.compare_digest(path, f"/{self._token}/".encode()):
            return connection.respond(HTTPStatus.NOT_FOUND, "not found\n")
        headers = Headers({
            "Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(self._page)), "Connection": "close",
            "Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff",
            "Content-Security-Policy": "frame-ancestors 'none'",
        })  # fmt: skip
        return Response(HTTPStatus.OK, "OK", headers, self._page)

    async def _talk(self, connection) -> None:
        """Serve one client until it leaves."""
        from websockets.exceptions import ConnectionClosed

        client = Client(connection)
        if len(self._clients) >= MAX_CLIENTS:  # after simultaneous handshakes
            return
        self._clients.append(client)
        self._tell_roles()
        try:
            async for text in connection:
                if not self._receive(client, text):
                    await connection.close(1008, "too many wrong messages")
                    break
        except ConnectionClosed:
            pass
        finally:
            controlled = self._clients[0] is client
            if controlled:
                self._put({"do": "release"})  # end its drag
            self._clients.remove(client)
            if controlled:
                self._tell_roles()

    def _receive(self, client: Client, text: str | bytes) -> bool:
        """Handle a message; returns False if the client is to be disconnected."""
        second = int(time.monotonic())
        client.count = client.count + 1 if second == client.second else 1
        client.second = second
        if client.count > MAX_RATE:
            return False
        try:
            message = parse_message(text)
        except BadMessage:
            client.errors += 1
            return client.errors < MAX_ERRORS
        if message["do"] == "drawn":
            client.ready = True
            self._send_frame(client)
        elif client is self._clients[0]:
            self._put(message)
        return True

    def _put(self, message: dict) -> None:
        self._waiting.append(message)
        self._arrived.set()

    def _publish(self, frame: bytes) -> None:
        self._frame, self._number = frame, self._number + 1
        for client in self._clients:
            self._send_frame(client)

    def _send_frame(self, client: Client) -> None:
        if client.ready and client.sent < self._number:
            client.ready, client.sent = False, self._number
            self._send(client, self._frame)

    def _tell_roles(self) -> None:
        for client in self._clients:
            self._send(client, json.dumps({"control": client is self._clients[0]}))

    def _send(self, client: Client, data: str | bytes) -> None:
        async def send() -> None:
            from websockets.exceptions import ConnectionClosed

            with suppress(ConnectionClosed):  # `_talk` removes it
                await client.socket.send(data)

        task = self._loop.create_task(send())
        task.add_done_callback(lambda done: done.exception())
