"""Our GAIL beside that of the package imitation, with a seed: ``python benchmarks/gail.py 0``.

Both learn `move` of two numbers (``cells.py``), with networks of the same sizes, PPO of the same
settings, the same demonstrations and as many frames, and are measured in the same scenes as they
learn. Writes ``results/peers/gail-seed0.json``.
"""

import json
import os
import subprocess
import sys

import cells
import torch
from measuring import PEERS, ROOT
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.envs import TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator

from ifo_grounding import keys
from ifo_grounding.baselines import GAIL, ActionDemonstrations
from ifo_grounding.data import Demonstrations, Truth
from ifo_grounding.files import write_json
from ifo_grounding.report import provenance
from ifo_grounding.report.results import by_scene
from ifo_grounding.training import AdversarialUpdates, SelfExaminationConfig, improve_policy

THEIRS = {"imitation": "logit", "imitation, own reward": "own"}
"""What the package pays: ours, log D - log(1 - D), or its own, -log(1 - D)."""


class OfNumbers(nn.Module):
    """A network of the two numbers, and of an action where it is given one."""

    def __init__(self, outputs: int, sizes: tuple[int, ...], more: int = 0, **options) -> None:
        super().__init__()
        self.layers = MLP(2 + more, outputs, num_cells=list(sizes), **options)

    def forward(self, image: Tensor, action: Tensor | None = None) -> Tensor:
        read = [cells.numbers(image)]
        if action is not None:
            read.append(nn.functional.one_hot(action.long(), keys.N_ACTIONS).float())
        return self.layers(torch.cat(read, -1))


class SmallGAIL(GAIL):
    """GAIL with a discriminator of the sizes of the package's, which pays the logit alone."""

    def __call__(self, batch):
        return AdversarialUpdates.__call__(self, batch)  # without the absorbing state

    def discriminator(self, demos, preset, **options):
        network = OfNumbers(1, cells.DISCRIMINATOR_SIZES, keys.N_ACTIONS, activation_class=nn.ReLU)
        return TensorDictModule(network, [keys.PIXELS, keys.ACTION], ["logit"])


def ours(seed: int) -> Tensor:
    """Train with a seed; return which scenes are solved at each measure, bool [M, EPISODES]."""
    torch.manual_seed(seed)
    images, actions = cells.demonstrated(seed)
    shown = ((f"{row}", image, "go there") for row, image in enumerate(images))
    seen = ActionDemonstrations(Demonstrations.from_episodes(shown), Truth(torch.cat(actions)))
    adversary = SmallGAIL(seen, swapped=False, prior=0.0, **cells.DISCRIMINATOR)
    policy = ProbabilisticActor(
        TensorDictModule(
            OfNumbers(keys.N_ACTIONS, cells.POLICY_SIZES), [keys.PIXELS], [keys.LOGITS]
        ),
        in_keys=[keys.LOGITS],
        distribution_class=Categorical,
        return_log_prob=True,
    )
    value = ValueOperator(OfNumbers(1, cells.POLICY_SIZES), [keys.PIXELS])
    solved = []

    @torch.no_grad()
    def act(image: Tensor) -> Tensor:
        return policy.get_dist(TensorDict({keys.PIXELS: image}, [len(image)])).logits.argmax(-1)

    def measure(_: int) -> dict[str, float]:
        solved.append(cells.solved_by(act))
        return {}

    ppo = {**cells.PPO, "value_lr": cells.PPO["lr"], "steps": cells.STEPS}
    rounds = {"iterations": cells.ROUNDS, "evaluate_every": cells.EVERY}
    improve_policy(
        TransformedEnv(cells.Cells(cells.WORLDS, seed=seed), adversary.reward),
        policy,
        value,
        SelfExaminationConfig(value_warmup=0, **rounds, **ppo),
        seed=seed,
        adversarial=adversary,
        callback=measure,
    )
    return torch.stack(solved)


def theirs(seed: int, reward: str) -> Tensor:
    """Train the package's with a seed; return the same."""
    here = ROOT / "benchmarks"
    ended = subprocess.run(
        [
            PEERS / "imitation" / "bin" / "python",
            here / "peers" / "imitation_gail.py",
            str(seed),
            reward,
        ],
        stdout=subprocess.PIPE,
        check=True,
        env={**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{here}", "OMP_NUM_THREADS": "1"},
    )
    return torch.tensor(json.loads(ended.stdout), dtype=torch.bool)


def main() -> None:
    torch.set_num_threads(1)
    seed, frames = int(sys.argv[1]), cells.WORLDS * cells.STEPS * cells.EVERY
    solved = {"ours": ours(seed)}
    solved |= {name: theirs(seed, reward) for name, reward in THEIRS.items()}
    results = {
        f"{name}, {frames * number}": by_scene(outcomes)
        for name, each in solved.items()
        for number, outcomes in enumerate(each, 1)
    }
    print({name: f"{found['rate']['rate']:.1%}" for name, found in results.items()})
    out = {"options": {"seed": seed}, "results": results, "provenance": provenance()}
    write_json(ROOT / "results" / "peers" / f"gail-seed{seed}.json", out)


if __name__ == "__main__":
    main()
