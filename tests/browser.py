"""Fixtures for a real browser with software rendering: Debian's chromium, started once, with a new page per test."""

import os
import shutil
import time
from pathlib import Path

import pytest

FLAGS = (
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
LONGEST = 120.0  # longest wait for a busy machine [s]
SIZE = {"width": 480, "height": 360}  # size of the window [px]


def until(page, condition: str, seconds: float = LONGEST) -> None:
    """Wait until a JavaScript expression is true. Playwright's own way needs eval, which the page's policy forbids."""
    end = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < end, f"{condition} did not become true"
        page.wait_for_timeout(20)


def drag_up(page, spot: tuple[float, float], steps: int, rise: float) -> None:
    """Press the mouse at a point [px] and move it up by `rise` [px] in each of the steps, without releasing it."""
    page.mouse.move(*spot)
    page.mouse.down()
    for i in range(steps):
        page.mouse.move(spot[0], spot[1] - rise * i)
        page.wait_for_timeout(40)


@pytest.fixture(scope="session")
def chromium(tmp_path_factory):
    """The running browser; tests that need it are skipped if it is not installed."""
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("no chromium on this machine (apt-get install chromium)")
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    profile = tmp_path_factory.mktemp("profile")
    with sync_api.sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            profile, executable_path=path, args=FLAGS, headless=True, viewport=SIZE,
            env={**os.environ, "HOME": str(profile)},
        )  # fmt: skip
        context.set_default_timeout(1000 * LONGEST)
        yield context
        context.close()


@pytest.fixture
def open_page(chromium):
    """A function that opens a page, which is a file or an address, and returns it once it is `loaded`.

    The test fails on errors of the page, and if the page fetches anything but its address and the files `beside` it.
    """
    errors, pages = [], []

    def open_(place: Path | str, loaded: str = "window.player !== undefined", beside: Path | None = None):
        page = chromium.new_page()
        address = place.as_uri() if isinstance(place, Path) else place
        allowed = (address, "data:", "blob:", *([beside.as_uri()] if beside else []))
        pages.append(page)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.on("request", lambda request: None if request.url.startswith(allowed)
                else errors.append(request.url))  # fmt: skip
        page.goto(address)
        until(page, loaded)
        return page

    yield open_
    for page in pages:
        page.close()
    assert not errors
