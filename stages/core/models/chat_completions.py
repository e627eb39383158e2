"""Client for OpenAI-compatible chat completion endpoints, including many local servers; standard library only."""

from __future__ import annotations

import base64
import json
import logging
import os
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from http.client import HTTPException, HTTPResponse, IncompleteRead
from typing import TypeVar
from urllib.parse import urlsplit

from stages.core.errors import InputError

log = logging.getLogger(__name__)
URL = "https://api.openai.com/v1"
ATTEMPTS, PAUSE = 3, 2.0  # attempts with a busy or silent server; pause before the second, then doubled [s]
LONGEST_PAUSE = 60.0  # longest pause accepted from a server's Retry-After header [s]
RETRY_STATUSES = (408, 409, 429, 500, 502, 503, 504)  # HTTP statuses worth retrying
MAX_TIMEOUT = 86_400  # largest timeout of a request [s]; sockets accept no infinite one
LARGEST_REPLY = 4 << 20  # size at which reading a reply stops [bytes]; usable replies have a few thousand characters
T = TypeVar("T")


class InvalidReply(ValueError):
    """A reply that cannot be used; its message is sent back to the model."""


class _BrokenAnswer(Exception):
    """An HTTP response that does not contain a reply."""


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Treats redirects as errors: they would send the key to the other host, and turn the request into a GET."""

    def redirect_request(self, *_):
        return None


@dataclass(frozen=True)
class ChatEndpoint:
    """URL, model and key of an endpoint."""

    url: str
    model: str
    key: str = ""  # sent if not empty; never printed
    timeout: float = 120.0  # timeout of one request [s]

    @staticmethod
    def from_environment(model: str = "", timeout: float = 120.0, url: str = "") -> ChatEndpoint:
        """Build from OPENAI_API_KEY and, unless given, OPENAI_BASE_URL and OPENAI_MODEL.

        Raises InputError for unusable values.
        """
        url = (url or os.environ.get("OPENAI_BASE_URL", "").strip() or URL).rstrip("/")
        model = model or os.environ.get("OPENAI_MODEL", "").strip()
        key = os.environ.get("OPENAI_API_KEY", "").strip()
        if not _is_address(url):
            raise InputError(f"OPENAI_BASE_URL={url}: must begin with http:// or https://, such as {URL}, and "
                             "contain no "
                             "password")  # fmt: skip
        if not model:
            raise InputError(
                f"--model: no model of {url} is named; name one that accepts images with --model or OPENAI_MODEL"
            )
        if not key and url == URL:
            raise InputError(f"{url} needs a key: set OPENAI_API_KEY, or OPENAI_BASE_URL for a server without keys")
        if not (key.isascii() and key.isprintable()):
            raise InputError(
                "OPENAI_API_KEY: has characters that are not allowed in a key, such as a line break; copy the key again"
            )
        if not 0 < timeout <= MAX_TIMEOUT:
            raise InputError(f"--timeout {timeout:g}: give a time above 0 s and at most {MAX_TIMEOUT} s")
        return ChatEndpoint(url, model, key, timeout)

    def ask(self, messages: list[dict]) -> str:
        """Send messages; return the text of the reply, which may be empty. Raises InputError if there is no reply."""
        problem, pause = "", PAUSE
        for attempt in range(ATTEMPTS):
            if attempt:
                log.info("%s: %s; sending the request again in %.1f s", self.url, problem, pause)
                time.sleep(pause)
            pause = PAUSE * 2**attempt
            try:
                return _text(self._post({"model": self.model, "messages": messages}))
            except urllib.error.HTTPError as error:
                problem = f"{error.code} {error.reason}{self._why(error)}"
                if error.code not in RETRY_STATUSES:
                    raise InputError(f"{self.url}: {problem}; {self._advice(error)}") from error
                pause = max(pause, _retry_after(error))
            except _BrokenAnswer as error:
                problem = str(error)
            except (OSError, HTTPException) as error:  # URLError and TimeoutError are OSErrors
                problem = self._silence(error)
        raise InputError(
            f"{self.url}: {problem}, in each of {ATTEMPTS} attempts; try again later, or use another OPENAI_BASE_URL"
        )

    def ask_until_valid(self, messages: list[dict], parse: Callable[[str], T], tries: int) -> tuple[T, list[str]]:
        """Ask until `parse` accepts a reply; return its result, and all replies.

        The reason of an InvalidReply is sent back to the model. Raises InvalidReply with the last reason after `tries`
        replies, and InputError if there is no reply.
        """
        replies: list[str] = []
        while True:
            replies.append(self.ask(messages))
            try:
                return parse(replies[-1]), replies
            except InvalidReply as error:
                log.info("%s's answer cannot be used: %s", self.model, error)
                if len(replies) == tries:
                    raise
                reason = f"That cannot be used: {error}. Answer again, with JSON alone."
                messages = [*messages, {"role": "assistant", "content": replies[-1]},
                            {"role": "user", "content": reason}]  # fmt: skip

    def _post(self, body: dict) -> bytes:
        headers = {"Content-Type": "application/json", "User-Agent": "ngff"}
        if self.key:
            headers["Authorization"] = f"Bearer {self.key}"
        request = urllib.request.Request(f"{self.url}/chat/completions", json.dumps(body).encode(), headers)
        end = time.monotonic() + self.timeout
        with urllib.request.build_opener(_NoRedirects).open(request, timeout=self.timeout) as answer:
            return _read(answer, end)

    def _advice(self, error: urllib.error.HTTPError) -> str:
        if error.code in (401, 403):
            return "check OPENAI_API_KEY" if self.key else "the server needs a key: set OPENAI_API_KEY"
        if error.code == 404:
            return f"check OPENAI_BASE_URL, which often ends in /v1, and that it has the model {self.model!r}"
        if 300 <= error.code < 400:
            return f"it refers to {error.headers.get('Location', 'elsewhere')[:200]}; set OPENAI_BASE_URL to the " \
                   "address that answers itself"  # fmt: skip
        return f"check that the model {self.model!r} accepts images, and this many"

    def _silence(self, error: Exception) -> str:
        reason = getattr(error, "reason", error)
        if isinstance(reason, TimeoutError):
            return f"no answer within {self.timeout:g} s"
        if isinstance(reason, IncompleteRead):
            return "the answer breaks off"
        return f"no connection ({' '.join(str(reason).split()) or type(reason).__name__})"

    def _why(self, error: urllib.error.HTTPError) -> str:
        """Return the server's own error message, shortened, without the key."""
        try:
            said = json.loads(error.read(10_000))["error"]
            said = said["message"] if isinstance(said, dict) else said
        except (ValueError, KeyError, TypeError, RecursionError, OSError, HTTPException):
            return ""
        said = " ".join(str(said).split())
        return f" ({(said.replace(self.key, '[key]') if self.key else said)[:200]})"


def _is_address(url: str) -> bool:
    try:
        parts = urlsplit(url)
        return parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0 and \
            parts.username is None  # fmt: skip
    except ValueError:  # such as a port that is not a number
        return False


def _read(answer: HTTPResponse, end: float) -> bytes:
    """Read the whole response until the time `end`; the timeout of a socket only limits the wait for the next byte."""
    blocks, size = [], 0
    while block := answer.read1(1 << 16):
        blocks.append(block)
        size += len(block)
        if size > LARGEST_REPLY:
            raise _BrokenAnswer(f"its answer is larger than {LARGEST_REPLY >> 20} MB")
        if time.monotonic() > end:
            raise TimeoutError
    if answer.length:  # bytes that were announced but did not arrive
        raise IncompleteRead(b"", answer.length)
    return b"".join(blocks)


def _text(body: bytes) -> str:
    try:
        text = json.loads(body)["choices"][0]["message"]["content"]
    except (ValueError, KeyError, IndexError, TypeError, RecursionError) as error:
        raise _BrokenAnswer("its answer has no choices[0].message.content, as OpenAI's have (OPENAI_BASE_URL often "
                            "ends in /v1)") from error  # fmt: skip
    return text if isinstance(text, str) else ""


def _retry_after(error: urllib.error.HTTPError) -> float:
    """Return the seconds that the server asks to wait, at most LONGEST_PAUSE; 0 if it gives none, or a date."""
    try:
        seconds = float(error.headers.get("Retry-After", 0))
    except ValueError:
        return 0.0
    return min(seconds, LONGEST_PAUSE) if seconds > 0 else 0.0


def json_object(reply: str) -> dict:
    """Parse the single JSON object in a reply, which may be within prose or a Markdown code fence.

    Raises InvalidReply for any other reply.
    """
    start = reply.find("{")
    if start < 0 or reply.lstrip().startswith("["):
        raise InvalidReply("it is not a JSON object")
    try:
        data, end = _DECODER.raw_decode(reply, start)
    except InvalidReply:
        raise
    except (ValueError, RecursionError) as error:
        raise InvalidReply(f"it is not JSON ({error})") from error
    if "{" in reply[end:]:
        raise InvalidReply("it has more than one JSON object")
    return data


def _once(pairs: list[tuple[str, object]]) -> dict:
    keys = [key for key, _ in pairs]
    if len(set(keys)) < len(keys):
        raise InvalidReply("a name occurs twice")
    return dict(pairs)


def _not_a_number(word: str) -> float:
    raise InvalidReply(f"{word} is not a number")


_DECODER = json.JSONDecoder(object_pairs_hook=_once, parse_constant=_not_a_number)


def image_part(jpeg: bytes) -> dict:
    """Return a JPEG image as a part of a message."""
    return {"type": "image_url", "image_url": {"url": "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()}}
