"""Draw the pictures of the README: ``python docs/make_assets.py RUN`` after a demo run.

``world.png`` shows a scene of each task; ``agent.gif`` the policy of that run (a name or a path).
"""

import sys

import torch
from pages import write

from ifo_grounding import networks
from ifo_grounding.evaluation import record_episodes
from ifo_grounding.files import read_json
from ifo_grounding.report import Captioned, animation, gallery
from ifo_grounding.report.theme import GOOD
from ifo_grounding.tasks import TASKS, VOCABULARY, SceneOptions, SceneStream
from ifo_grounding.training import Run
from ifo_grounding.world import render

SCENES = range(4)


def world() -> bytes:
    cases = []
    for number, task in enumerate(TASKS):
        stream = SceneStream(SceneOptions(task, stream="validation"), seed=0)
        scene = stream.scenes(torch.tensor([3 * number]))
        (sentence,) = VOCABULARY.decode(scene.instruction)
        picture = render(scene.state, tile_size=32)[0].numpy()
        cases.append(Captioned(picture, sentence, note=task, colour=GOOD))
    return gallery(cases, columns=len(cases))


def agent(run: Run) -> bytes:
    policy = networks.load(run.need("policy-phase2.safetensors", "two_phase"))
    task = read_json(run.need("options.json", "two_phase"))["task"]
    shown = record_episodes(policy, task, SCENES, stream="validation", render_tile_size=32)
    return animation(shown, columns=len(SCENES), width=180)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python docs/make_assets.py RUN")
    write({}, {"world.png": world(), "agent.gif": agent(Run(sys.argv[1]))})
