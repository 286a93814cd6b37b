"""Draw the pictures of the README: ``python docs/make_assets.py RUN`` after a demo run.

``world.png`` shows a scene of each task; ``before-after.gif`` what phase 2 of that run (a name
or a path) has mended.
"""

import sys

import torch
from pages import write

from ifo_grounding import networks
from ifo_grounding.evaluation import record_episodes
from ifo_grounding.report import Captioned, animation, gallery
from ifo_grounding.report.theme import GOOD
from ifo_grounding.tasks import TASKS, VOCABULARY, SceneOptions, SceneStream
from ifo_grounding.training import Run
from ifo_grounding.world import render

SCENES, TRIED = 4, 60


def world() -> bytes:
    cases = []
    for number, task in enumerate(TASKS):
        stream = SceneStream(SceneOptions(task, stream="validation"), seed=0)
        scene = stream.scenes(torch.tensor([3 * number]))
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
    titles = [title for title in ("imitation", "after practice") for _ in range(SCENES)]
    return animation(both, titles=titles, columns=SCENES, width=180)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python docs/make_assets.py RUN")
    pictures = {"world.png": world(), "before-after.gif": before_and_after(Run(sys.argv[1]))}
    write({}, pictures)
