"""Draw the pictures of the README: ``python docs/make_assets.py RUN`` after a demo run.

``world.png`` shows a scene of each task; ``agent.gif`` a policy of that run (a name or a path). One
that was trained with ``world.split=train`` gives ``evidence.png`` instead: what its words say.
"""

import sys
from pathlib import Path
from typing import Any

import torch

from ifo_grounding import networks
from ifo_grounding.evaluation import record_episodes, word_evidence
from ifo_grounding.files import atomic_write, read_json
from ifo_grounding.report import Case, animation, evidence_figure, figure_png, gallery
from ifo_grounding.tasks import TASKS, VOCABULARY, SceneOptions, SceneStream
from ifo_grounding.tasks.grammar import HOLDOUTS
from ifo_grounding.training import Run
from ifo_grounding.world import render

ASSETS = Path(__file__).parent / "assets"
SCENES = range(4)


def world() -> bytes:
    cases = []
    for number, task in enumerate(TASKS):
        stream = SceneStream(SceneOptions(task, stream="validation"), seed=0)
        scene = stream.scenes(torch.tensor([3 * number]))
        (sentence,) = VOCABULARY.decode(scene.instruction)
        picture = render(scene.state, tile_size=32)[0].numpy()
        cases.append(Case(picture, sentence, good=True, note=task))
    return gallery(cases, columns=len(cases))


def agent(run: Run) -> bytes:
    policy = networks.load(run.need("policy-phase2.safetensors", "two_phase"))
    task = read_json(run.need("options.json", "two_phase"))["task"]
    shown = record_episodes(policy, task, SCENES, stream="validation", render_tile_size=32)
    return animation(shown, columns=len(SCENES), width=180)


def evidence(run: Run, options: dict[str, Any]) -> bytes:
    policy = networks.load(run.need("policy-phase1.safetensors", "two_phase"))
    return figure_png(evidence_figure(word_evidence(policy), HOLDOUTS[options["world"]["holdout"]]))


def main() -> None:
    if len(sys.argv) != 2:
        raise SystemExit("usage: python docs/make_assets.py RUN")
    run = Run(sys.argv[1])
    options = read_json(run.need("options.json", "two_phase"))
    if options["world"]["split"] == "train":
        pictures = {"evidence.png": evidence(run, options)}
    else:
        pictures = {"world.png": world(), "agent.gif": agent(run)}
    for name, content in pictures.items():
        with atomic_write(ASSETS / name) as temporary:
            temporary.write_bytes(content)


if __name__ == "__main__":
    main()
