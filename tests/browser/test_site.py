"""The documentation as a reader sees it: built, served and opened in headless Chromium."""

import functools
import http.server
import threading

import pytest
from mkdocs.commands.build import build
from mkdocs.config import load_config

from browser.conftest import SCREENS, new_tab
from test_docs import ROOT

pytestmark = [pytest.mark.browser, pytest.mark.timeout(1200)]

SOME = ("", "phase2", "table-2", "speed", "own-world")
"""Pages with equations, wide tables, pictures and code."""


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *said):
        """Say nothing."""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built documentation, and its address."""
    folder = tmp_path_factory.mktemp("site")
    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(folder), strict=True))
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield folder, f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.fixture(params=SCREENS)
def opened(request, browser, site):
    """A tab on one screen, what it asked of other machines and what it complained of."""
    page = new_tab(browser, request.param, base_url=site[1])
    yield page
    page.context.close()


@pytest.mark.parametrize("which", ["some", pytest.param("all", marks=pytest.mark.slow)])
def test_pages_are_whole_without_a_network(opened, site, which):
    equations = 0
    every = sorted(site[0].rglob("index.html"))
    for index in every if which == "all" else [site[0] / page / "index.html" for page in SOME]:
        opened.goto(index.parent.relative_to(site[0]).as_posix() + "/")
        opened.wait_for_function("[...document.images].every(image => image.complete)")
        assert opened.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0, index
        pictures = opened.evaluate("[...document.images].map(i => i.alt && i.naturalWidth)")
        assert all(pictures), f"{index}: a picture that is missing or has no words"
        drawn, found = opened.locator(".katex-html").count(), opened.locator(".arithmatex").count()
        assert drawn == found, f"{index}: {found} equations, {drawn} drawn"
        equations += drawn
    assert equations > 10
    assert [url for url in opened.asked if not url.startswith(site[1])] == []
    assert opened.complaints == []


def test_search_finds_a_word(opened):
    opened.goto("./")
    if opened.viewport_size["width"] < 500:
        opened.locator("label[for=__search]").first.click()
    opened.locator(".md-search__input").fill("self-examination")
    opened.locator(".md-search-result__link").first.wait_for()
    assert "phase2" in opened.locator(".md-search-result__link").first.get_attribute("href")
