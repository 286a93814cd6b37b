"""The smallest networks and environments that both training loops take."""

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import ProbabilisticActor

from ifo_grounding import keys
from ifo_grounding.data import Demonstrations, labelled_buffer
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.tasks import grammar
from ifo_grounding.training import SelfExaminationConfig, select_pairs
from ifo_grounding.transforms import InstructionSampler, LearnedReward

POOL = grammar("move").tokens


class Tiny(nn.Module):
    """Numbers from the mean colour of an image and the mean of the words' vectors."""

    def __init__(self, outputs, dropout=0.0):
        super().__init__()
        self.words = nn.Embedding(64, 8)
        self.head = nn.Sequential(nn.Dropout(dropout), nn.Linear(11, 32), nn.ReLU())
        self.out = nn.Linear(32, outputs)

    def forward(self, pixels, instruction):
        colour = pixels.float().mean((-1, -2)) / 255
        return self.out(self.head(torch.cat([colour, self.words(instruction).mean(-2)], -1)))


def tiny(outputs, out_key, **kwargs):
    return TensorDictModule(Tiny(outputs, **kwargs), [keys.PIXELS, keys.INSTRUCTION], [out_key])


def make_policy(dropout=0.0):
    torch.manual_seed(0)
    return ProbabilisticActor(
        tiny(keys.N_ACTIONS, keys.LOGITS, dropout=dropout),
        in_keys=[keys.LOGITS],
        distribution_class=Categorical,
        return_log_prob=True,
    )


def make_networks(value_key=keys.STATE_VALUE):
    return make_policy(), tiny(1, value_key)


def prefer(policy, action, by=1.0):
    """Make a policy likelier to take an action."""
    with torch.no_grad():
        policy[0].module.out.bias[action] += by


def weights(*networks):
    return [weight.clone() for network in networks for weight in network.state_dict().values()]


def same(some, others):
    return all(map(torch.equal, some, others))


def accepts_all():
    """An instruction classifier that finds everything suitable."""

    def score(pixels, instruction):
        return torch.full((*instruction.shape[:-1], 1), 5.0)

    return TensorDictModule(score, [keys.PIXELS, keys.INSTRUCTION], [keys.SUITABILITY])


def likes(action):
    """A reward model that likes one action."""

    def score(pixels, instruction, taken):
        return ((taken == action).float() * 8 - 4).unsqueeze(-1)

    return TensorDictModule(
        score, [keys.PIXELS, keys.INSTRUCTION, keys.ACTION], [keys.ACTION_SCORE]
    )


def simulator(num_envs=16, **kwargs):
    return PickAndPlaceEnv("move", num_envs, seed=0, instructed=False, **kwargs)


def sampler():
    return InstructionSampler(accepts_all(), POOL)


def make_env(reward_model=None, num_envs=16):
    reward = LearnedReward(reward_model or likes(1))
    return TransformedEnv(simulator(num_envs), Compose(sampler(), reward))


def pairs():
    return select_pairs(simulator(8), accepts_all(), POOL, 24, seed=0)


def config(**kwargs):
    chosen = {"iterations": 2, "steps": 4, "minibatch": 32, "value_warmup": 0, "epochs": 1}
    return SelfExaminationConfig(**{**chosen, **kwargs})


def labelled(action, lengths=(3, 5, 2) * 20):
    """Demonstrations of some lengths in which every label is one action."""
    draw = torch.Generator().manual_seed(0)
    frames = [
        torch.randint(256, (length, 3, 48, 48), dtype=torch.uint8, generator=draw)
        for length in lengths
    ]
    demos = Demonstrations.from_arrays(frames, ["move to the red circle"] * len(lengths))
    return labelled_buffer(demos, torch.full((demos.transitions,), action))


def kill_at(last):
    """Return a log that ends the process before the checkpoint of a step."""

    def log(metrics, step):
        if step == last:
            raise KeyboardInterrupt

    return log


TEACH = {"gamma": 0.0, "lr": 1e-1, "entropy": 0.0, "epochs": 3}
"""Options with which the tiny policy learns an action within a few iterations."""
