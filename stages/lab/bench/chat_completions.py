"""Client of OpenAI-compatible chat completion endpoints (many local servers are), standard library only."""

from __future__ import annotations

import base64
import json
import logging
import os
import time
import urllib.error
import urllib.request
from dataclasses import dataclass
from http.client import HTTPException

from stages.core.errors import InputError

log = logging.getLogger(__name__)
URL = "https://api.openai.com/v1"
ATTEMPTS, PAUSE = 3, 2.0  # on a busy or silent server; pause before the second attempt, then doubling [s]
RETRY_STATUSES = (408, 409, 429, 500, 502, 503, 504)  # HTTP statuses worth retrying


@dataclass(frozen=True)
class ChatEndpoint:
    """URL, model and key of an endpoint."""

    url: str
    model: str
    key: str = ""  # sent if not empty; never printed
    timeout: float = 120.0  # of one request [s]

    @staticmethod
    def from_environment(model: str = "", timeout: float = 120.0) -> ChatEndpoint:
        """From OPENAI_BASE_URL, OPENAI_API_KEY and, unless given, OPENAI_MODEL; InputError for unusable values."""
        url = os.environ.get("OPENAI_BASE_URL", "").strip().rstrip("/") or URL
        model = model or os.environ.get("OPENAI_MODEL", "").strip()
        if not url.startswith(("http://", "https://")):
            raise InputError(f"OPENAI_BASE_URL={url}: must begin with http:// or https://, such as {URL}")
        if not model:
            raise InputError(f"which model of {url}? name one that accepts images with --model or OPENAI_MODEL")
        if timeout <= 0:
            raise InputError(f"--timeout {timeout:g}: give seconds above 0")
        return ChatEndpoint(url, model, os.environ.get("OPENAI_API_KEY", "").strip(), timeout)

    def ask(self, messages: list[dict]) -> str:
        """Send messages; the text of the reply. Raises InputError when there is none."""
        problem = ""
        for attempt in range(ATTEMPTS):
            if attempt:
                wait = PAUSE * 2 ** (attempt - 1)
                log.info("%s: %s; asking again in %.1f s", self.url, problem, wait)
                time.sleep(wait)
            try:
                return self._text(self._post({"model": self.model, "messages": messages}))
            except urllib.error.HTTPError as error:
                problem = f"{error.code} {error.reason}{_why(error)}"
                if error.code not in RETRY_STATUSES:
                    raise InputError(f"{self.url}: {problem}; {self._advice(error.code)}") from error
            except (OSError, HTTPException) as error:  # URLError and TimeoutError are OSErrors
                problem = self._silence(error)
        raise InputError(f"{self.url}: {problem}, {ATTEMPTS} times; try later, or another OPENAI_BASE_URL")

    def _post(self, body: dict) -> bytes:
        headers = {"Content-Type": "application/json", "User-Agent": "ngff-lab"}
        if self.key:
            headers["Authorization"] = f"Bearer {self.key}"
        request = urllib.request.Request(f"{self.url}/chat/completions", json.dumps(body).encode(), headers)
        with urllib.request.urlopen(request, timeout=self.timeout) as answer:
            return answer.read()

    def _text(self, body: bytes) -> str:
        try:
            text = json.loads(body)["choices"][0]["message"]["content"]
        except (ValueError, KeyError, IndexError, TypeError) as error:
            raise InputError(f"{self.url}: its answer has no choices[0].message.content, as OpenAI's have; "
                             "check OPENAI_BASE_URL, which often ends in /v1") from error  # fmt: skip
        return text if isinstance(text, str) else ""

    def _advice(self, code: int) -> str:
        if code in (401, 403):
            return "check OPENAI_API_KEY" if self.key else "the server needs a key: set OPENAI_API_KEY"
        if code == 404:
            return f"check OPENAI_BASE_URL, which often ends in /v1, and that it has the model {self.model!r}"
        return f"check that the model {self.model!r} accepts images"

    def _silence(self, error: Exception) -> str:
        reason = getattr(error, "reason", error)
        if isinstance(reason, TimeoutError):
            return f"no answer within {self.timeout:g} s"
        return f"no connection ({reason or type(reason).__name__})"


def _why(error: urllib.error.HTTPError) -> str:
    """The server's own error message, shortened."""
    try:
        said = json.loads(error.read(10_000))["error"]
        said = said["message"] if isinstance(said, dict) else said
    except (ValueError, KeyError, TypeError, OSError, HTTPException):
        return ""
    return f" ({' '.join(str(said).split())[:200]})"


def image_part(jpeg: bytes) -> dict:
    """A JPEG image as a part of a message."""
    return {"type": "image_url", "image_url": {"url": "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()}}
