"""The gateway's pages in a real headless Chromium, as somebody who has come in sees them."""

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from gateways import Service

playwright = pytest.importorskip("playwright.sync_api")

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
NEEDED = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")
PHONE = {"width": 390, "height": 844}
SIZES = {"wide": {"width": 1280, "height": 900}, "phone": PHONE}
AXE = os.environ.get("PUP_AXE")
"""File axe.min.js of axe-core, where accessibility is to be checked by it."""
SHOTS = os.environ.get("PUP_SHOTS")
"""Folder for pictures of the pages, where they are wanted."""


@contextmanager
def chromium() -> Iterator[Any]:
    with playwright.sync_playwright() as p:
        made = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield made
        made.close()


@contextmanager
def opener(
    browser: Any, service: Service, is_wrong: Callable[[Any], bool]
) -> Iterator[Callable[..., Any]]:
    """Opens a page as somebody; no page may fail, nor ask for anything elsewhere.

    Args:
      browser: made by `chromium`.
      service: whose pages they are.
      is_wrong: whether a message on a page's console may not be there.
    """
    contexts, wrong = [], []

    def opened(role: str | None = "operator", **options: Any) -> Any:
        context = browser.new_context(base_url=service.url, **options)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(60_000)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda m: wrong.append(m.text) if is_wrong(m) else None)
        page.on(
            "request",
            lambda r: (
                None if r.url.startswith(service.url) else wrong.append(f"elsewhere: {r.url}")
            ),
        )
        page.on("dialog", lambda dialog: dialog.accept())
        if role:
            page.goto("/login")
            page.get_by_label("Token").fill(service.tokens[role])
            page.get_by_role("button", name="Enter").click()
            page.wait_for_url("**/")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert wrong == []


def shot(page: Any, name: str) -> None:
    if SHOTS:
        Path(SHOTS).mkdir(parents=True, exist_ok=True)
        page.screenshot(path=f"{SHOTS}/{name}.png", full_page=True)


def contrast(part: Any) -> float:
    """Of a part's text and its own background, as WCAG has it."""
    told = part.evaluate("p => [getComputedStyle(p).color, getComputedStyle(p).backgroundColor]")
    darker, lighter = sorted(map(_luminance, told))
    return (lighter + 0.05) / (darker + 0.05)


def _luminance(colour: str) -> float:
    shares = [int(n) / 255 for n in re.findall(r"\d+", colour)[:3]]
    red, green, blue = (s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def check(page: Any, path: str, size: str) -> None:
    """That a page fits on its screen, and that axe finds nothing."""
    page.goto(path)
    page.locator("h1").wait_for()
    wide = page.evaluate("document.documentElement.scrollWidth")
    assert wide <= SIZES[size]["width"], f"{path} is wider than the screen"
    shot(page, f"{size}{path.replace('/', '_')}")
    if AXE:
        page.evaluate(Path(AXE).read_text())
        found = page.evaluate("axe.run()")["violations"]
        told = [(v["id"], v["nodes"][0]["html"][:200]) for v in found]
        assert told == [], path
