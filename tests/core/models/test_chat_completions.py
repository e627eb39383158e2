"""The client of OpenAI's chat protocol, tested with a local server that fails in several ways."""

import pytest

from stages.core.errors import InputError
from stages.core.models import chat_completions
from stages.core.models.chat_completions import ChatEndpoint, InvalidReply, json_object
from tests.chat_server import KEY

QUESTION = [{"role": "user", "content": "well?"}]
CHOICES = "choices\\[0\\].message.content"


def ask(timeout=30.0, **options) -> str:
    return ChatEndpoint.from_environment(timeout=timeout, **options).ask(QUESTION)


def truncated(handler):
    handler.answer((200, {"Content-Length": "1000"}))


def silent(handler):
    """Send nothing until the client disconnects."""
    handler.rfile.read(1)


def dripping(handler):
    """Send one byte at a time, each before the timeout of the socket."""
    handler.wfile.write(b"HTTP/1.0 200 OK\r\n\r\n")
    try:
        while True:
            handler.wfile.write(b" ")
            handler.wfile.flush()
            chat_completions.time.sleep(0.03)
    except OSError:  # the client has disconnected
        pass


def test_question_and_reply(chat_server):
    chat_server.script = ["well"]
    assert ask() == "well"
    assert chat_server.asked == [("/v1/chat/completions", {"model": "seer", "messages": QUESTION})]
    assert chat_server.keys == [f"Bearer {KEY}"]


@pytest.mark.parametrize(("script", "says"), [
    ([401], "401 .*so it is.*; check OPENAI_API_KEY"), ([404], "404 .*has the model 'seer'"), ([400], "accepts images"),
    ([503, 500, 429], "429 .*, in each of 3 attempts; try again later"),
    ([b"<html>"] * 3, CHOICES), ([b"{}"] * 3, CHOICES),
    ([b'{"choices": []}'] * 3, CHOICES), ([b"[" * 100_000] * 3, CHOICES), ([b"\xff\xfe"] * 3, CHOICES),
    ([b" " * 5000] * 3, "larger than 0 MB, in each of 3 attempts"),
    ([truncated] * 3, "breaks off, in each of 3 attempts"),
    (["close"] * 3, "no connection .*, in each of 3 attempts"),
    ([silent] * 3, "no answer within 0.1 s, in each of 3 attempts"),
    ([dripping] * 3, "no answer within 0.1 s, in each of 3 attempts"),
])  # fmt: skip
def test_failing_servers(chat_server, monkeypatch, script, says):
    monkeypatch.setattr(chat_completions, "LARGEST_REPLY", 4000)
    if script[0] == b"[" * 100_000:
        monkeypatch.setattr(chat_completions, "LARGEST_REPLY", 200_000)
    chat_server.script = list(script)
    with pytest.raises(InputError, match=says) as caught:
        ask(timeout=0.1 if "0.1 s" in says else 30.0)
    assert KEY not in str(caught.value) and "\n" not in str(caught.value)
    chat_server.wait_for(len(script))
    assert len(chat_server.asked) == len(script)


@pytest.mark.parametrize("first", [503, silent, "close", truncated, b"<html>"])
def test_what_passes_is_tried_again(chat_server, first):
    # the third reply is used if the machine is too slow to send the second one within the timeout
    chat_server.script = [first, "well", "well"]
    assert ask(timeout=0.5 if first is silent else 30.0) == "well"


@pytest.mark.parametrize(
    ("header", "pause"), [("0.05", 0.05), ("9999", 60.0), ("-5", 0.01), ("soon", 0.01), ("nan", 0.01)]
)
def test_retry_after_is_obeyed_within_limits(chat_server, monkeypatch, header, pause):
    slept = []
    monkeypatch.setattr(chat_completions.time, "sleep", slept.append)
    chat_server.script = [(429, {"Retry-After": header}), "well"]
    assert ask() == "well" and slept == [pause]


def test_a_redirect_gets_neither_key_nor_question(chat_server):
    chat_server.script = [(302, {"Location": f"{chat_server.url}/elsewhere"})]
    with pytest.raises(InputError, match="302 .*refers to .*/elsewhere; set OPENAI_BASE_URL"):
        ask()
    assert len(chat_server.asked) == 1


def test_unusable_settings_are_reported_before_anything_is_sent(chat_server, monkeypatch):
    for url in ("localhost:1/v1", "http://", "http://x:port/v1", "http://[/v1", "http://me:secret@x/v1"):
        with pytest.raises(InputError, match="must begin with http"):
            ask(url=url)
    with pytest.raises(InputError, match="no connection"):
        ask(url="http://127.0.0.1:9/v1")  # no server listens on this port
    for timeout in (0.0, -1.0, float("nan"), float("inf"), 1e30):
        with pytest.raises(InputError, match="--timeout"):
            ask(timeout=timeout)
    monkeypatch.setenv("OPENAI_API_KEY", "two\nlines")
    with pytest.raises(InputError, match="OPENAI_API_KEY: has characters"):
        ask()
    monkeypatch.delenv("OPENAI_MODEL")
    with pytest.raises(InputError, match="--model or OPENAI_MODEL"):
        ask()
    assert not chat_server.asked


def test_openai_needs_a_key_and_other_servers_may_do_without(chat_server, monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY")
    chat_server.script = ["well", 401]
    assert ask() == "well" and chat_server.keys == [None]
    with pytest.raises(InputError, match="set OPENAI_API_KEY"):
        ask()
    monkeypatch.delenv("OPENAI_BASE_URL")
    with pytest.raises(InputError, match="https://api.openai.com/v1 needs a key: set OPENAI_API_KEY"):
        ask()


def test_invalid_replies_are_sent_back_with_the_reason(chat_server):
    endpoint = ChatEndpoint.from_environment()
    chat_server.script = ["about a half", '{"score": 0.5}']
    assert endpoint.ask_until_valid(QUESTION, json_object, 2) == ({"score": 0.5}, ["about a half", '{"score": 0.5}'])
    last = chat_server.asked[1][1]["messages"]
    assert last[1] == {"role": "assistant", "content": "about a half"} and "not a JSON object" in last[2]["content"]
    chat_server.script = ["no", ""]
    with pytest.raises(InvalidReply, match="not a JSON object"):
        endpoint.ask_until_valid(QUESTION, json_object, 2)


@pytest.mark.parametrize("reply", [
    '{"a": 1}', '```json\n{"a": 1}\n```', 'I would say\n{"a": 1}\nor so.',
])  # fmt: skip
def test_json_may_stand_in_prose(reply):
    assert json_object(reply) == {"a": 1}


@pytest.mark.parametrize(("reply", "says"), [
    ("A half.", "not a JSON object"), ("", "not a JSON object"), ('[{"a": 1}]', "not a JSON object"),
    ('{"a": 1', "not JSON"), ('{"a": 1} {"a": 2}', "more than one"), ('{"a": NaN}', "NaN is not a number"),
    ('{"a": 1, "a": 2}', "twice"), ('{"a":' * 100_000, "not JSON"), ('{"a": ' + "9" * 5000, "not JSON"),
])  # fmt: skip
def test_what_is_not_one_json_object(reply, says):
    with pytest.raises(InvalidReply, match=says):
        json_object(reply)
