"""What must not change: scenes, frames, demonstrations, choices, losses and both phases.

A change that is meant writes these files anew, and says why in the CHANGELOG:

    python tests/golden/test_golden.py
"""

import functools
import hashlib
import json
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from ifo_grounding import keys
from ifo_grounding.data import (
    collect_transitions,
    first_frame_buffer,
    goal_buffer,
    label_demonstrations,
    labelled_buffer,
    record_demonstrations,
)
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.evaluation import success_rate
from ifo_grounding.networks import (
    make_goal_classifier,
    make_instruction_classifier,
    make_inverse,
    make_policy,
    make_reward_model,
    make_value,
)
from ifo_grounding.objectives import (
    GoalLoss,
    ImitationLoss,
    InstructionLoss,
    InverseLoss,
    RewardLoss,
)
from ifo_grounding.tasks import TASKS
from ifo_grounding.training import FitConfig, SelfExaminationConfig, fit, self_examine
from ifo_grounding.transforms import GoalReward, InstructionSampler, LearnedReward

FOLDER = Path(__file__).parent
PRESETS = ("paper", "strong")
LOSSES = ("inverse", "imitation", "instruction", "reward", "goal")
TRACE = FitConfig(steps=20, batch_size=32, lr=1e-3, iteration=1)
TOLERANCE = {"rel_tol": 2e-3, "abs_tol": 2e-4}
"""Of numbers with a fraction: processors round differently."""


def digest(*tensors):
    found = hashlib.blake2b(digest_size=8)
    for tensor in tensors:
        found.update(tensor.cpu().contiguous().numpy().tobytes())
    return found.hexdigest()


@functools.cache
def demonstrations(task="move"):
    return record_demonstrations(task, 64, seed=0)


@functools.cache
def collected():
    simulator = PickAndPlaceEnv("move", num_envs=32, seed=0, instructed=False)
    return collect_transitions(simulator, 1024, seed=0)


@functools.cache
def labels():
    """The inverse model of twenty steps knows little: labels are what it says, right or not."""
    inverse = make_inverse(demonstrations(), "strong", seed=0)
    fit(InverseLoss(inverse), collected().buffer, TRACE, seed=0)
    return label_demonstrations(demonstrations(), inverse)[1].actions


def scenes(task):
    """Hash first frames and instructions, and the frames of fixed actions, resets included."""
    env = PickAndPlaceEnv(task, num_envs=16, seed=0, stream="evaluation")
    state = env.reset()
    found = [digest(state[keys.PIXELS], state[keys.INSTRUCTION])]
    shown = []
    for number in range(48):
        state[keys.ACTION] = (torch.arange(16) + 5 * number) % 6
        stepped = env.step(state)
        shown.append(digest(stepped[keys.NEXT, keys.PIXELS], stepped[keys.NEXT, keys.REWARD]))
        state = env.step_mdp(stepped)
        state = env.maybe_reset(state)
    return [*found, hashlib.blake2b("".join(shown).encode(), digest_size=8).hexdigest()]


def recorded(task):
    demos = demonstrations(task)
    frames = demos.frames(torch.arange(demos.n_frames))
    return [digest(frames), digest(demos.lengths), digest(demos.instructions), demos.n_frames]


def chosen():
    """Which instructions a sampler chooses, and in which scenes."""
    classifier = make_instruction_classifier(demonstrations(), "strong", seed=0)
    env = PickAndPlaceEnv("move", num_envs=16, seed=0, instructed=False)
    sampler = InstructionSampler(classifier, demonstrations().pool(), threshold=0.3, seed=0)
    env = TransformedEnv(env, sampler)
    return [env.reset()[keys.INSTRUCTION].sum(-1).tolist() for _ in range(2)]


def loss_of(name, preset):
    """Build a loss, and the buffer that it learns from."""
    demos = demonstrations()
    build = {"seed": 0, "dropout": 0.0}
    if name == "inverse":
        return InverseLoss(make_inverse(demos, preset, **build)), collected().buffer
    if name == "imitation":
        return ImitationLoss(make_policy(demos, preset, **build)), labelled_buffer(demos, labels())
    if name == "instruction":
        network = make_instruction_classifier(demos, preset, **build)
        return InstructionLoss(network, demos.pool(), contrast=1.0), first_frame_buffer(demos)
    if name == "reward":
        return RewardLoss(make_reward_model(demos, preset, **build)), labelled_buffer(
            demos, labels()
        )
    return GoalLoss(make_goal_classifier(demos, preset, **build), demos.pool()), goal_buffer(demos)


def losses(name, preset):
    history = fit(*loss_of(name, preset), TRACE, seed=0)
    return [row[f"loss_{name}"] for row in history]


def phases(preset):
    """Both phases of a tiny run: losses, learned rewards, and success in the end."""
    demos = demonstrations()
    policy = make_policy(demos, preset, seed=0, dropout=0.0)
    loss, buffer = ImitationLoss(policy), labelled_buffer(demos, labels())
    imitated = fit(loss, buffer, TRACE, seed=0)
    classifier = make_instruction_classifier(demos, preset, init_from=policy, seed=0, dropout=0.0)
    env = PickAndPlaceEnv("move", num_envs=16, seed=0, instructed=False)
    sampler = InstructionSampler(classifier, demos.pool(), threshold=0.2)
    if preset == "paper":
        reward = LearnedReward(make_reward_model(demos, preset, seed=0, dropout=0.0))
    else:
        reward = GoalReward(make_goal_classifier(demos, preset, seed=0), stop_action=5)
    config = SelfExaminationConfig(
        algorithm="reinforce" if preset == "paper" else "ppo",
        iterations=3,
        steps=12,
        minibatch=64,
        epochs=1,
        value_warmup=1,
        gamma=0.0 if preset == "paper" else 0.95,
    )
    value = make_value(demos, preset, init_from=policy, seed=0)
    env = TransformedEnv(env, Compose(sampler, reward))
    history = self_examine(env, policy, value, config, seed=0)
    names = ("learned_reward", "episode_length", "states_drawn", "loss_objective")
    return {
        "imitation": [row["loss_imitation"] for row in imitated],
        **{name: [row[name] for row in history if name in row] for name in names},
        "success": success_rate(policy, "move", episodes=100).rate.rate,
    }


MADE = {
    **{f"scenes-{task}": functools.partial(scenes, task) for task in TASKS},
    **{f"demonstrations-{task}": functools.partial(recorded, task) for task in TASKS},
    "chosen": chosen,
    **{f"{n}-{p}": functools.partial(losses, n, p) for n in LOSSES for p in PRESETS},
    **{f"phases-{preset}": functools.partial(phases, preset) for preset in PRESETS},
}


def differences(made, golden, where=""):
    """Yield where two values differ by more than rounding."""
    if isinstance(golden, dict):
        assert made.keys() == golden.keys()
        for name in golden:
            yield from differences(made[name], golden[name], f"{where}.{name}")
    elif isinstance(golden, list):
        assert len(made) == len(golden), where
        for number, pair in enumerate(zip(made, golden, strict=True)):
            yield from differences(*pair, f"{where}[{number}]")
    elif isinstance(golden, float):
        if not math.isclose(made, golden, **TOLERANCE):
            yield f"{where}: {made} is no longer {golden}"
    elif made != golden:
        yield f"{where}: {made} is no longer {golden}"


@pytest.mark.parametrize("name", MADE)
def test_golden(name):
    golden = json.loads((FOLDER / "golden.json").read_text())
    assert not list(differences(MADE[name](), golden[name]))


def test_a_difference_is_seen():
    golden = {"losses": [0.5, 1.0], "frames": "ab"}
    assert not list(differences({"losses": [0.5004, 1.0], "frames": "ab"}, golden))
    assert len(list(differences({"losses": [0.51, 1.0], "frames": "cd"}, golden))) == 2


def test_one_batch_has_the_gradient_it_had():
    """The sum of all gradients' norms of the policy's first step, preset strong."""
    loss, buffer = loss_of("imitation", "strong")
    torch.manual_seed(0)
    batch: TensorDict = buffer.sample(16)
    loss(batch)["loss_imitation"].backward()
    norms = [p.grad.norm() for p in loss.parameters() if p.grad is not None]
    golden = json.loads((FOLDER / "golden.json").read_text())["gradient"]
    assert math.isclose(float(torch.stack(norms).sum()), golden, rel_tol=5e-3)


if __name__ == "__main__":
    torch.set_num_threads(1)
    made = {}
    for name, make in MADE.items():
        torch.manual_seed(0)
        made[name] = make()
    loss, buffer = loss_of("imitation", "strong")
    torch.manual_seed(0)
    loss(buffer.sample(16))["loss_imitation"].backward()
    made["gradient"] = sum(float(p.grad.norm()) for p in loss.parameters() if p.grad is not None)
    (FOLDER / "golden.json").write_text(json.dumps(made, indent=1) + "\n")
