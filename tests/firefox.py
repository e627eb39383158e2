"""Firefox on a virtual display with software rendering, controlled directly by WebDriver BiDi."""

import itertools
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.browser import LONGEST

PREFERENCES = {
    "webgl.force-enabled": True,
    "app.normandy.enabled": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "browser.shell.checkDefaultBrowser": False,
}


class FirefoxPage:
    """One page with the same `evaluate` as playwright's pages; `errors` are the error messages so far."""

    def __init__(self, socket, address: str):
        self._socket, self._number, self.errors = socket, itertools.count(1), []
        self._call("session.new", capabilities={})
        self._call("session.subscribe", events=["log.entryAdded", "network.beforeRequestSent"])
        self._context = self._call("browsingContext.getTree")["contexts"][0]["context"]
        self._address = address
        self._call("browsingContext.navigate", context=self._context, url=address, wait="complete")

    def evaluate(self, script: str, argument: object = None) -> object:
        """The awaited value of an expression, or of a function called with `argument`."""
        function = script if "=>" in script else f"() => ({script})"
        found = self._call(
            "script.callFunction",
            functionDeclaration=f"async (text) => JSON.stringify(await ({function})(JSON.parse(text)))",
            arguments=[{"type": "string", "value": json.dumps(argument)}],
            target={"context": self._context}, awaitPromise=True,
        )  # fmt: skip
        assert found["type"] == "success", found["exceptionDetails"]["text"]
        return json.loads(found["result"].get("value", "null"))

    def wait_for_timeout(self, milliseconds: float) -> None:
        """Wait while the page continues."""
        self.evaluate("ms => new Promise(resolve => setTimeout(resolve, ms))", milliseconds)

    def _call(self, method: str, **parameters: object) -> dict:
        number = next(self._number)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=LONGEST))
            if message.get("id") == number:
                assert message["type"] == "success", message
                return message["result"]
            self._note(message)

    def _note(self, event: dict) -> None:
        if event.get("method") == "log.entryAdded" and event["params"]["level"] == "error":
            self.errors.append(event["params"]["text"])
        if event.get("method") == "network.beforeRequestSent":
            url = event["params"]["request"]["url"]
            if not url.startswith((self._address, "data:", "blob:", "about:")):
                self.errors.append(url)


@pytest.fixture
def open_firefox(tmp_path):
    """Function that opens a file in Firefox; the test fails if the page has errors or fetches anything."""
    for program in ("firefox", "Xvfb"):
        if shutil.which(program) is None:
            pytest.skip(f"no {program} on this machine (apt-get install firefox-esr xvfb libgl1-mesa-dri)")
    from websockets.sync.client import connect

    profile, processes, sockets, pages = tmp_path / "profile", [], [], []
    profile.mkdir()
    lines = (f'user_pref("{name}", {json.dumps(value)});\n' for name, value in PREFERENCES.items())
    (profile / "user.js").write_text("".join(lines))

    def start(words: list[str], pattern: str, **options: object) -> str:
        """Start a program and return the part of its output that matches the group in `pattern`."""
        processes.append(subprocess.Popen(words, stderr=subprocess.PIPE, text=True, **options))
        found = (re.search(pattern, line) for line in processes[-1].stderr)
        return next(match[1] for match in found if match)

    def open_(path: Path) -> FirefoxPage:
        reading, writing = os.pipe()
        processes.append(subprocess.Popen(["Xvfb", "-displayfd", str(writing), "-screen", "0", "800x600x24"],
                                          pass_fds=[writing], stderr=subprocess.DEVNULL))  # fmt: skip
        os.close(writing)
        with os.fdopen(reading) as numbers:
            display = f":{numbers.readline().strip()}"
        address = start(
            ["firefox", "--no-remote", "--profile", str(profile), "--remote-debugging-port", "0", "about:blank"],
            r"(ws://\S+)",
            env={**os.environ, "HOME": str(profile), "DISPLAY": display, "LIBGL_ALWAYS_SOFTWARE": "1",
                 "MOZ_WEBGL_FORCE_EGL": "1"},
        )  # fmt: skip
        sockets.append(connect(f"{address}/session", max_size=1 << 26))
        pages.append(FirefoxPage(sockets[-1], path.as_uri()))
        return pages[-1]

    yield open_
    for socket in sockets:
        socket.close()
    for process in reversed(processes):
        process.kill()
        process.wait()
    assert not [error for page in pages for error in page.errors]
