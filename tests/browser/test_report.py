"""The report of a run, opened in headless Chromium as a reader would open it."""

import io

import numpy as np
import pytest
from PIL import Image

from browser.conftest import SCREENS, new_tab
from ifo_grounding.options import options_of
from importing import recipes_importable

pytestmark = pytest.mark.browser

TEXTS = """[...document.querySelectorAll('main *')]
    .filter(part => [...part.childNodes].some(n => n.nodeType == 3 && n.textContent.trim()))"""


@pytest.fixture(scope="module")
def page_of_a_run(tmp_path_factory):
    """The report of both phases, made by the recipes."""
    run = tmp_path_factory.mktemp("browser") / "run"
    with recipes_importable():
        from two_phase import two_phase

        from report import report

        options = options_of("task=pick", "budget=tiny", f"run={run}", "progress=false")
        two_phase(options)
        return report(options)


@pytest.fixture(params=[(s, c) for s in SCREENS for c in ("light", "dark")], ids="-".join)
def opened(request, browser, page_of_a_run):
    """The report on one screen in one colour scheme, and what it asked for and complained of."""
    screen, scheme = request.param
    page = new_tab(browser, screen, color_scheme=scheme, offline=True)
    page.scheme = scheme
    page.goto(page_of_a_run.as_uri())
    page.evaluate("document.querySelectorAll('details').forEach(part => part.open = true)")
    page.wait_for_function("[...document.images].every(image => image.complete)")
    yield page
    page.context.close()


def test_it_needs_no_network_and_shows_every_picture(opened, page_of_a_run):
    outside = [url for url in opened.asked if not url.startswith("data:")]
    assert outside == [page_of_a_run.as_uri()]
    assert opened.complaints == []
    widths = opened.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert len(widths) >= 10
    assert min(widths) > 0
    headings = opened.locator("h2").all_inner_texts()
    wanted = ("All that was measured", "Step by step, scene 0", "Chosen instructions")
    for heading in (*wanted, "How self-examination went"):
        assert heading in headings


def test_it_fits_the_screen(opened):
    overflow = opened.evaluate("document.documentElement.scrollWidth - window.innerWidth")
    assert overflow <= 0  # what is wider scrolls within its own box
    small = opened.evaluate(f"{TEXTS}.map(part => parseFloat(getComputedStyle(part).fontSize))")
    assert min(small) >= 12


def test_the_table_of_results_shows_whole_intervals(opened):
    hidden = opened.evaluate(
        """[...document.querySelectorAll('table')]
        .map(table => table.scrollWidth - table.parentElement.clientWidth)"""
    )
    assert max(hidden) <= 0


def test_colours_follow_the_scheme(opened):
    picture = np.array(Image.open(io.BytesIO(opened.screenshot())).convert("L"))
    assert (picture[:, :4].mean() < 60) == (opened.scheme == "dark")
    plots = opened.locator(".plot img")
    assert plots.count() > 1
    shown = np.array(Image.open(io.BytesIO(plots.first.screenshot())).convert("L"))
    assert (np.median(shown) < 60) == (opened.scheme == "dark")


def test_text_stands_out(opened):
    """At least 4.5 to 1, as WCAG asks, for every text of the page."""
    ratios = opened.evaluate(
        """(() => {
        const luminance = colour => {
            const [r, g, b] = colour.match(/[\\d.]+/g).slice(0, 3).map(Number).map(v => v / 255)
                .map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
            return 0.2126 * r + 0.7152 * g + 0.0722 * b;
        };
        const behind = part => {
            for (; part; part = part.parentElement) {
                const colour = getComputedStyle(part).backgroundColor;
                if (!/, 0\\)$|transparent/.test(colour)) return colour;
            }
        };
        return """
        + TEXTS
        + """.map(part => {
            const pair = [luminance(getComputedStyle(part).color), luminance(behind(part))];
            const [low, high] = pair.sort((a, b) => a - b);
            return (high + 0.05) / (low + 0.05);
        });
        })()"""
    )
    assert min(ratios) >= 4.5
