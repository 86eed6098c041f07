"""Contents and external resources of an HTML page, and its screenshot in a browser."""

import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

BROWSER = "chromium-headless-shell"
"""Chromium without a desktop: a third of the packages, but enough for a screenshot."""

LOADED = {"src", "poster", "srcset", "xlink:href", "data"}
"""Attributes whose targets a browser loads without a click."""


class Page(HTMLParser):
    """Parsed page: its tags and its text."""

    def __init__(self, html: str):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.unclosed: list[str] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in ("meta", "link", "img", "br", "input"):
            self.unclosed.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.unclosed.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += f"{data} "

    def of(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]


def needs_no_other_file(html: str) -> None:
    """Assert that all tags are closed, and that the page has no scripts, external resources or links."""
    page = Page(html)
    assert not page.unclosed
    assert not page.of("script")
    assert not page.of("link")
    loaded: list[str] = []
    for _, attributes in page.tags:
        loaded += [value for name, value in attributes.items() if name in LOADED]
    assert {value.split(":")[0] for value in loaded if not value.startswith("#")} <= {"data"}
    assert "http" not in re.sub(r"data:[a-z0-9/]+;base64,[A-Za-z0-9+/=\s]+", "", html)
    assert not re.search(r"@import|url\((?!#)", html)


def screenshot(page: Path, width_px: int, height_px: int) -> NDArray[np.float64]:
    """Take a screenshot of a page in a browser; return its grey levels (height_px, width_px)."""
    assert shutil.which(BROWSER), f"{BROWSER} is not installed; bash setup.sh test installs it"
    picture = page.with_name("shown.png")
    options = ("--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars")
    quiet = ("--disable-background-networking", "--disable-component-update", "--disable-sync")
    profile = page.with_name("profile")
    target = (f"--screenshot={picture}", f"--window-size={width_px},{height_px}", f"--user-data-dir={profile}")
    # A limit of `subprocess` would end the browser's start script alone, and then wait for its other processes.
    limit = ("timeout", "--kill-after=10", "120")
    subprocess.run([*limit, BROWSER, *options, *quiet, *target, page.as_uri()], check=True, capture_output=True)
    grey_levels = np.asarray(Image.open(picture).convert("L"), float)
    assert grey_levels.shape == (height_px, width_px)
    return grey_levels
