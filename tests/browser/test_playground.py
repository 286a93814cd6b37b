"""The playground as a person uses it: watched, talked to, arranged, taught, by clicking."""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import re
import socket
import subprocess
import sys

import pytest

from browser.conftest import SCREENS, new_tab
from ifo_grounding.data import load_lerobot, load_pictures, record_demonstrations
from ifo_grounding.networks import from_pretrained, make_inverse, make_policy, make_value
from ifo_grounding.networks import load as load_network
from ifo_grounding.playground import Agent, Source
from ifo_grounding.tasks import grammar
from ifo_grounding.worlds import Grid
from importing import recipes_importable
from test_docs import ROOT

pytestmark = [pytest.mark.browser, pytest.mark.timeout(600)]
MOVE = "ifo-grounding/move"
TINY = ("world=own", "world._target_=ifo_grounding.worlds.OpenGrid", "task=taught", "budget=tiny")


SECONDS_OF_A_STEP = """() => new Promise(done => {
  const said = () => document.querySelector('#boards figure p').innerText;
  const before = said(), begun = performance.now();
  const watch = setInterval(() => {
    if (said() != before) { clearInterval(watch); done((performance.now() - begun) / 1000); }
  }, 2);
  [...document.querySelectorAll('button')].find(one => one.innerText.trim() == 'Step').click();
})"""


@functools.cache
def load(name):
    """The trained networks of the package beside a policy that has learned nothing."""
    if name == "broken":
        return load_network("/nowhere/policy.safetensors")
    if name != MOVE:
        with recipes_importable():
            return importlib.import_module("play").load(name)
    world = Grid("move")
    simulator = world.simulator(1, seed=0)
    others = {kind: from_pretrained(MOVE, kind=kind) for kind in ("instruction", "goal")}
    others |= {"value": make_value(simulator, seed=0), "inverse": make_inverse(simulator, seed=0)}
    policies = {
        "imitation": make_policy(simulator, seed=0),
        "self-examination": from_pretrained(MOVE, kind="policy"),
    }
    return Agent(world, policies, grammar("move").tokens, teach=TINY, **others)


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """A page that is served, its home a folder of its own."""
    from ifo_grounding.playground import page

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("IFO_GROUNDING_HOME", str(tmp_path_factory.mktemp("home")))
        blocks = page.build_page(Source(load, (MOVE, "broken")))
        look = {"theme": page.theme(), "css": page.drawing.STYLE, "ssr_mode": False}
        *_, url, _ = blocks.launch(prevent_thread_lock=True, quiet=True, **look)
        yield url
        blocks.close()


@pytest.fixture
def opened(browser, address):
    with contextlib.closing(new_tab(browser, "desktop").context) as context:
        yield enter(context.pages[0], address)


def enter(page, address):
    page.set_default_timeout(40_000)
    page.goto(address)
    page.locator("#boards img").first.wait_for()
    page.wait_for_function(
        "document.querySelectorAll('#completions button, #completions td').length"
    )
    return page


def button(page, name):
    return page.get_by_role("button", name=name, exact=True)


def says(page, where, text):
    page.locator(where).get_by_text(re.compile(text)).first.wait_for()


def typed(page, sentence):
    page.locator("#sentence textarea").fill("")
    page.locator("#sentence textarea").press_sequentially(sentence)


def tell(page, sentence):
    typed(page, sentence)
    button(page, "Tell").click()


@pytest.mark.parametrize("screen", SCREENS)
def test_a_scene_is_watched(browser, address, screen):
    with contextlib.closing(new_tab(browser, screen).context) as context:
        page = enter(context.pages[0], address)
        boards = page.locator("#boards")
        assert boards.locator("figure").count() == 2
        assert boards.locator(".bar").count() == 2 * 6
        says(page, "#boards", "step 0 of .* · value .* · goal classifier")
        assert boards.locator("polyline").count() >= 2
        button(page, "Step").click()
        says(page, "#boards", "step 1 of")
        button(page, "Back").click()
        says(page, "#boards", "step 0 of")
        before = boards.locator("rect").count()
        page.get_by_label("Where it looks").check()
        page.wait_for_function(f"document.querySelectorAll('#boards rect').length > {before}")
        button(page, "Play").click()
        says(page, "#boards", "it stopped · fulfilled, says the goal classifier")
        page.get_by_label("Seed").fill("3")
        page.get_by_label("Seed").press("Enter")
        says(page, "#boards", "after imitation")
        button(page, "Next scene").click()
        page.wait_for_function("[...document.querySelectorAll('input')].some(i => i.value == '1')")
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
        here = address.split("//")[1].split("/")[0]
        assert [url for url in page.asked if here not in url and not url.startswith("data:")] == []


def test_the_agent_is_talked_to(opened):
    typed(opened, "move to the yel")
    opened.locator("#completions").get_by_text("move to the yellow circle").wait_for()
    tell(opened, "fly to the purple moon")
    says(opened, "#status", "the policy has never heard 'fly', 'moon'")
    tell(opened, "<img src=x onerror=alert(1)> red")
    says(opened, "#status", "the policy has never heard")
    assert opened.locator("#status img").count() == 0
    tell(opened, "")
    says(opened, "#status", "0 words|Say something")
    tell(opened, "triangle")
    says(opened, "#status", "no sentence of this task, so that nobody can judge it")
    typed(opened, "tri")
    says(opened, "#status", "Go on, or choose")
    typed(opened, "triangle")  # as it was told: heard once more, it keeps what was said of it
    says(opened, "#status", "no sentence of this task, so that nobody can judge it")
    says(opened, "#boards", "step 0 of")
    opened.locator("#completions button").first.click()
    says(opened, "#status", "In truth: (it suits|it is so|something|the place)")
    button(opened, "Play").click()
    says(opened, "#boards", "in truth: (not )?fulfilled")


def test_a_scene_is_arranged(opened):
    def put(what, cell):
        opened.locator("#tool").get_by_label(what, exact=True).check()
        opened.locator(f"#boards figure [data-cell='{cell}']").first.click()

    opened.get_by_text("Arrange the scene").click()
    tell(opened, "move to the yellow diamond")
    says(opened, "#status", "something that it names is not here")
    put("yellow diamond", 0)
    says(opened, "#status", "it suits this scene")
    put("yellow diamond", 35)
    says(opened, "#status", "something that it names is here more than once")
    put("take away", 0)
    says(opened, "#status", "it suits this scene")
    put("the arm", 35)
    says(opened, "#status", "it is so already")
    put("gray box", 34)
    button(opened, "As it was").click()
    says(opened, "#status", "it suits this scene")


def show(page, sentence, times=1):
    page.get_by_role("tab", name="Teach by showing").click()
    page.locator("#shown textarea").fill(sentence)
    there = page.locator("#lessons tr[data-row]").count()
    for number in range(times):
        page.locator("#pad").focus()
        for key in ("ArrowUp", "ArrowLeft", "ArrowDown"):
            page.keyboard.press(key)
        page.locator("#pad").get_by_role("button", name="stop").click()
        page.locator("#lessons tr[data-row]").nth(there + number).wait_for()


def test_a_person_shows_something(opened, browser, address, tmp_path):
    opened.get_by_role("tab", name="Teach by showing").click()
    opened.locator("#pad").get_by_role("button", name="up").click()
    says(opened, "#taught", "say first what you show")
    show(opened, "go round <b>once</b>")
    show(opened, "wave", times=2)
    assert opened.locator("#lessons b").count() == 0  # what was typed is text
    opened.locator("#lessons tr[data-row]").nth(1).click()
    opened.get_by_alt_text("frame 1").wait_for()
    button(opened, "Throw away the chosen one").click()
    opened.wait_for_function("document.querySelectorAll('#lessons tr[data-row]').length == 2")
    button(opened, "Train both phases").click()
    says(opened, "#taught", "2 demonstrations: show at least 4")
    folders = {}
    for form in ("demonstrations", "png", "gif", "lerobot"):
        opened.get_by_label("Save as").click()
        opened.get_by_role("option", name=form, exact=True).click()
        button(opened, "Save").click()
        opened.wait_for_timeout(300)
        says(opened, "#taught", "Written: ")
        opened.wait_for_function(
            f"![{','.join(map(repr, folders.values()))}]"
            ".includes(document.querySelector('#taught').innerText)"
        )
        folders[form] = opened.locator("#taught").inner_text()
    where = {form: said.partition("Written: ")[2].strip() for form, said in folders.items()}
    assert len(load_pictures(where["png"])) == len(load_pictures(where["gif"])) == 2
    assert load_lerobot(where["lerobot"]).sentences()[1] == "wave"
    with contextlib.closing(new_tab(browser, "desktop").context) as other:  # somebody else
        page = enter(other.pages[0], address)
        page.get_by_role("tab", name="Teach by showing").click()
        page.locator("#pad img").wait_for()
        assert page.locator("#lessons tr[data-row]").count() == 0
    enter(opened, address)  # the tab was closed, and opened again
    opened.get_by_role("tab", name="Teach by showing").click()
    opened.locator("#lessons tr[data-row]").nth(1).wait_for()


@pytest.mark.slow
def test_both_phases_are_trained_from_what_was_shown(opened):
    show(opened, "go round", times=2)
    show(opened, "wave", times=2)
    button(opened, "Train both phases").click()
    says(opened, "#progress", "ifo-grounding demo world=own")
    opened.locator("#progress").get_by_text("trained: watch it").wait_for(timeout=400_000)
    button(opened, "Watch what was trained").click()
    opened.get_by_role("tab", name="Watch and talk").click()
    opened.locator("#completions").get_by_text("wave").wait_for()
    says(opened, "#boards", "after imitation")
    button(opened, "Play").click()
    says(opened, "#boards", "in truth: nobody knows")


def test_recordings_are_looked_at(opened, tmp_path):
    demos = record_demonstrations("move", 6, seed=0)
    demos.save(tmp_path / "six")
    opened.get_by_role("tab", name="Look at recordings").click()
    for folder, said in (("nowhere", "is no folder of demonstrations"), (tmp_path, "meta.json")):
        opened.locator("#folder textarea").fill(str(folder))
        button(opened, "Look").click()
        says(opened, "#looked", said)
    opened.locator("#folder textarea").fill(str(tmp_path / "six"))
    button(opened, "Look").click()
    says(opened, "#looked", "6 demonstrations, those first that look wrong")
    assert opened.locator("#recorded tr[data-row]").count() == 6
    opened.locator("#recorded tr[data-row]").first.click()
    opened.locator("#film").get_by_alt_text("frame 1").wait_for()
    assert re.search(r"\d+%", opened.locator("#film").inner_text())  # labels, with confidence


def test_networks_that_are_broken_are_said(opened):
    opened.get_by_label("Networks").click()
    opened.get_by_role("option", name="broken").click()
    says(opened, "#status", "/nowhere/policy.safetensors")


def test_a_step_is_seen_at_once(opened):
    opened.get_by_label("Scene").fill("1")
    opened.get_by_label("Scene").press("Enter")
    says(opened, "#boards", "step 0 of")
    times = [opened.evaluate(SECONDS_OF_A_STEP) for _ in range(8)]
    print("seconds a step:", sorted(times))
    assert min(times) < 0.15  # on an idle machine every one is


@pytest.mark.slow
def test_the_hosted_form_starts(opened, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    named = {**os.environ, "PORT": str(port), "IFO_GROUNDING_HOME": str(tmp_path)}
    command = [sys.executable, str(ROOT / "space" / "app.py")]
    hosted = subprocess.Popen(command, env=named, stdout=subprocess.PIPE, text=True)
    try:
        said = [hosted.stdout.readline() for _ in range(2)]
        assert "anyone who reaches this machine" in said[1]
        enter(opened, f"http://127.0.0.1:{port}")
        says(opened, "#boards", "after self-examination")
        opened.get_by_role("tab", name="Look at recordings").click()
        opened.locator("#folder textarea").fill("/etc")
        button(opened, "Look").click()
        says(opened, "#looked", "this page is shared")
    finally:
        hosted.terminate()
        hosted.wait()
