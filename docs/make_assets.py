"""Draw the pictures of the README: ``python docs/make_assets.py RUN`` after a demo run.

``world.png`` shows a scene of each task; ``before-after.gif`` what phase 2 of that run (a name
or a path) has mended; ``playground.gif`` the page at work, with the same run.
"""

import io
import shutil
import subprocess
import sys

import torch
from pages import write
from PIL import Image

from ifo_grounding import networks
from ifo_grounding.evaluation import record_episodes
from ifo_grounding.report import Captioned, animation, gallery
from ifo_grounding.report.animation import gif
from ifo_grounding.report.theme import GOOD
from ifo_grounding.tasks import TASKS, VOCABULARY, SceneOptions, draw_scenes
from ifo_grounding.training import Run
from ifo_grounding.world import render

SCENES, TRIED = 4, 60


def world() -> bytes:
    cases = []
    for number, task in enumerate(TASKS):
        options = SceneOptions(task, stream="validation")
        scene = draw_scenes(options, 0, torch.tensor([3 * number]))
        (sentence,) = VOCABULARY.decode(scene.instruction)
        picture = render(scene.state, tile_size=32)[0].numpy()
        cases.append(Captioned(picture, sentence, note=task, colour=GOOD))
    return gallery(cases, columns=len(cases))


def before_and_after(run: Run) -> bytes:
    """Show scenes in which the policy of phase 1 fails and that of phase 2 does not."""
    task = (run.options() or {})["task"]
    tries = []
    for phase in (1, 2):
        policy = networks.load(run.need(f"policy-phase{phase}.safetensors", "two_phase"))
        shown = {"stream": "validation", "render_tile_size": 32}
        tries.append(record_episodes(policy, task, range(TRIED), **shown))
    pairs = [pair for pair in zip(*tries, strict=True) if pair[1].success > pair[0].success]
    both = [episode for phase in zip(*pairs[:SCENES], strict=True) for episode in phase]
    titles = [title for title in ("imitation", "after self-examination") for _ in range(SCENES)]
    return animation(both, titles=titles, columns=SCENES, width=180)


def page_at_work(run: Run) -> bytes:
    """Type a sentence into the page, and let the agent follow it."""
    from playwright.sync_api import sync_playwright

    words = ["play", f"run={run.name}", "port=7899", "browser=false"]
    served = subprocess.Popen([sys.executable, "-m", "ifo_grounding", *words], stdout=-1, text=True)
    shots: list[bytes] = []
    try:
        assert served.stdout is not None and served.stdout.readline().startswith("http")
        with sync_playwright() as playwright:
            program = shutil.which("chromium") or shutil.which("chromium-browser")
            browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1200, "height": 1190})
            page.goto("http://127.0.0.1:7899")
            page.locator("#completions button").first.wait_for()
            page.locator("#sentence textarea").fill("")
            for letter in "move to the yellow triangle":
                page.locator("#sentence textarea").press_sequentially(letter)
                shots.append(page.screenshot())
            page.get_by_role("button", name="Tell", exact=True).click()
            for step in range(9):
                page.wait_for_timeout(1000)
                if not page.get_by_text(f"step {step} of").count():
                    break
                shots += 4 * [page.screenshot()]
                page.get_by_role("button", name="Step", exact=True).click()
            browser.close()
    finally:
        served.terminate()
    return gif(
        [Image.open(io.BytesIO(shot)).convert("RGB").resize((800, 793)) for shot in shots], 8
    )


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python docs/make_assets.py RUN")
    run = Run(sys.argv[1])
    pictures = {"world.png": world(), "before-after.gif": before_and_after(run)}
    pictures["playground.gif"] = page_at_work(run)
    write({}, pictures)
