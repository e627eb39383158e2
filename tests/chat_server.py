"""A local server with OpenAI's protocol that replies, correctly or not, as a test prescribes."""

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from stages.core.models import chat_completions

KEY = "not-a-real-key"


class Server(ThreadingHTTPServer):
    """Replies with the entries of `script`, one per request.

    An entry is the text of a reply; a status, or (status, headers); bytes as the body; a function that receives the
    handler and writes whatever it likes; or "close", which closes the connection without a reply.
    """

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.script, self.asked, self.keys = [], [], []
        self.url = f"http://127.0.0.1:{self.server_address[1]}/v1"

    def wait_for(self, requests: int) -> None:
        """Wait until this number of requests has been read, at most 2 min, since clients may give up before that."""
        for _ in range(12_000):
            if len(self.asked) >= requests:
                break
            time.sleep(0.01)


class Handler(BaseHTTPRequestHandler):
    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.asked.append((self.path, body))
        self.server.keys.append(self.headers.get("Authorization"))
        script = self.server.script
        reply = script(body) if callable(script) else script.pop(0)
        if callable(reply):
            reply(self)
        elif reply != "close":
            self.answer(reply)

    def do_GET(self):
        self.server.asked.append((self.path, None))
        self.server.keys.append(self.headers.get("Authorization"))
        self.answer("{}")

    def answer(self, reply):
        status, headers = (reply, {}) if isinstance(reply, int) else (200, {})
        if isinstance(reply, tuple):
            status, headers = reply
        if isinstance(reply, str):
            data = json.dumps({"choices": [{"message": {"role": "assistant", "content": reply}}]}).encode()
        elif isinstance(reply, bytes):
            data = reply
        else:
            data = json.dumps({"error": {"message": f"so it is with {KEY}"}}).encode()
        self.send_response(status)
        for name, value in {"Content-Length": str(len(data)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_):
        pass


@pytest.fixture
def chat_server(monkeypatch):
    made = Server()
    thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    for name, value in {"BASE_URL": made.url, "API_KEY": KEY, "MODEL": "seer"}.items():
        monkeypatch.setenv(f"OPENAI_{name}", value)
    monkeypatch.setattr(chat_completions, "PAUSE", 0.01)
    yield made
    made.shutdown()
    thread.join()
    made.server_close()
