"""CUDA graphs: which losses and optimisers they suit, and, on a GPU, that they learn the same."""

import contextlib

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from ifo_grounding.data import labelled_buffer, record_demonstrations
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.networks import (
    make_instruction_classifier,
    make_policy,
    make_reward_model,
    make_value,
)
from ifo_grounding.objectives import ImitationLoss, InstructionLoss, RewardLoss
from ifo_grounding.training import (
    AuxiliaryImitation,
    FitConfig,
    SelfExaminationConfig,
    fit,
    self_examine,
)
from ifo_grounding.training.policy_gradient import Learner
from ifo_grounding.training.updates import (
    CapturedUpdate,
    let_capture,
    make_optimizer,
    prepared,
    set_rates,
    update,
)
from ifo_grounding.transforms import InstructionSampler, LearnedReward


def test_an_optimizer_is_captured_or_not_whatever_a_checkpoint_says():
    weight = torch.nn.Parameter(torch.ones(2))
    optimizer = make_optimizer([weight], 0.1)
    let_capture(optimizer, True)
    rate = optimizer.param_groups[0]["lr"]
    set_rates(optimizer, 0.25)
    assert rate.item() == 0.25
    saved = optimizer.state_dict()
    other = make_optimizer([weight], 0.1)
    other.load_state_dict(saved)
    let_capture(other, False)
    assert (other.param_groups[0]["lr"], other.param_groups[0]["capturable"]) == (0.25, False)
    set_rates(other, 0.5)
    assert other.param_groups[0]["lr"] == 0.5
    weight.grad = torch.ones(2)
    other.step()
    assert (weight < 1).all()


def test_only_steps_that_are_all_the_same_can_be_captured():
    demos = record_demonstrations("move", 2, seed=0)
    assert ImitationLoss(make_policy(demos, "paper", seed=0)).capturable
    strong = make_policy(demos, "strong", seed=0)
    assert ImitationLoss(strong).capturable
    assert not ImitationLoss(strong, words_from=0.5).capturable  # penalises words later on
    suitable = make_instruction_classifier(demos, "paper", seed=0)
    assert InstructionLoss(suitable, demos.pool(), removal_rate=0.0).capturable
    assert not InstructionLoss(suitable, demos.pool(), removal_rate=0.3).capturable  # counts some


def test_a_step_that_cannot_be_captured_goes_on_kernel_by_kernel(monkeypatch):
    class Refused(contextlib.nullcontext):
        def __exit__(self, *_):
            raise RuntimeError("operation not permitted when stream is capturing")

    monkeypatch.setattr(torch.cuda, "CUDAGraph", object)
    monkeypatch.setattr(torch.cuda, "graph", Refused)
    monkeypatch.setattr(CapturedUpdate, "_aside", lambda captured, batch: captured.update(batch))
    seen = []
    captured = CapturedUpdate(lambda batch: seen.append(float(batch["x"])) or {"x": batch["x"]})
    batches = [TensorDict({"x": torch.tensor(float(n))}) for n in range(6)]
    found = [captured(batch) for batch in batches[:3]]
    with pytest.warns(UserWarning, match="cannot be one CUDA graph .*operation not permitted"):
        found.append(captured(batches[3]))
    found += [captured(batch) for batch in batches[4:]]
    assert [float(each["x"]) for each in found] == [0, 1, 2, 3, 4, 5]
    assert seen == [0, 1, 2, 3, 3, 4, 5]  # the fourth was recorded first, which computes nothing


@pytest.mark.gpu
def test_a_step_that_reads_something_back_learns_on_a_gpu():
    weight = torch.nn.Parameter(torch.ones(2, device="cuda"))
    optimizer = make_optimizer([weight], 0.1)

    def step(batch):
        loss = (weight * batch["x"]).sum()
        return update(TensorDict({"loss_mine": loss * float(loss > -100)}), optimizer, 1.0)

    made = prepared(step, optimizer, cudagraph=True)
    batch = TensorDict({"x": torch.ones(2, device="cuda")})
    with pytest.warns(UserWarning, match="cannot be one CUDA graph"):
        losses = [float(made(batch)["loss_mine"]) for _ in range(6)]
    assert losses == sorted(losses, reverse=True)
    assert losses[0] - losses[-1] > 0.9  # 0.1 of both weights in each step


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("make", "kind", "tolerance"),
    [(make_policy, ImitationLoss, 0.02), (make_reward_model, RewardLoss, 0.1)],
)
def test_a_captured_step_learns_what_single_kernels_learn(make, kind, tolerance, tmp_path):
    demos, truth = record_demonstrations("move", 200, seed=0, keep_truth=True)
    options = {"seed": 0, "device": "cuda", "dropout": 0.0}
    config = FitConfig(steps=60, batch_size=64, iteration=10)
    found = {}
    for cudagraph in (False, True):
        for until in (30, None):  # paused, and continued with other weights to begin with
            loss = kind(make(demos, "paper", **options))
            buffer = labelled_buffer(demos, truth.actions)
            buffer.transform.to("cuda")
            how = {"cudagraph": cudagraph, "checkpoint": tmp_path / f"{cudagraph}.pt"}
            history = fit(loss, buffer, config, seed=0, until=until, **how)
        found[cudagraph] = torch.tensor([list(row.values())[1] for row in history])
    assert (found[True] - found[False]).abs().max() < tolerance, found
    assert found[True][-1] < found[True][0]


@pytest.mark.gpu
@pytest.mark.parametrize("algorithm", ["ppo", "reinforce"])
def test_captured_practice_learns_what_single_kernels_learn(algorithm):
    demos, truth = record_demonstrations("move", 200, seed=0, keep_truth=True)
    buffer = labelled_buffer(demos, truth.actions)
    buffer.transform.to("cuda")
    simulator = PickAndPlaceEnv("move", 16, seed=0, device="cuda", instructed=False)
    options = {"seed": 0, "device": "cuda"}
    classifier = make_instruction_classifier(simulator, **options)
    reward = make_reward_model(simulator, **options)
    config = SelfExaminationConfig(algorithm, iterations=8, steps=8, minibatch=50, value_warmup=1)
    found = {}
    for cudagraph in (False, True):
        sampler = InstructionSampler(classifier, demos.pool(), threshold=0.0)
        env = TransformedEnv(simulator, Compose(sampler, LearnedReward(reward)))
        policy = make_policy(simulator, dropout=0.0, **options)
        value = make_value(simulator, init_from=policy, **options)
        imitation = AuxiliaryImitation(ImitationLoss(policy), buffer, 1.0, 64)
        how = {"imitation": imitation, "cudagraph": cudagraph}
        history = self_examine(env, policy, value, config, seed=0, **how)
        found[cudagraph] = torch.tensor([row["loss_imitation"] for row in history])
    assert (found[True] - found[False]).abs().max() < 0.1, found
    assert found[True][-1] < found[True][0]


@pytest.mark.gpu
def test_neither_the_world_nor_an_update_waits_for_the_gpu():
    env = PickAndPlaceEnv("move", 64, seed=0, device="cuda", codes=True)
    reward = LearnedReward(make_reward_model(env, seed=0, device="cuda"))
    policy = make_policy(env, seed=0, device="cuda").eval()
    value = make_value(env, seed=0, device="cuda", init_from=policy).eval()
    learner = Learner(policy, value, SelfExaminationConfig(steps=4, minibatch=64, epochs=2))
    learner.prepare(cudagraph=True)
    with torch.no_grad():
        batch = TransformedEnv(env, reward).rollout(4, policy, break_when_any_done=False)
    learner.improve(batch, iteration=3)  # captures
    steps = TensorDict({"collected": batch.exclude("next").reshape(-1)[:64]}, device="cuda")
    world, actions = env._simulator, torch.randint(6, (12, 64), device="cuda")
    world.reset()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for action in actions:
            _, terminated, truncated = world.step(action)
            world.reset(terminated | truncated)
        metrics = learner.captured(steps)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert learner.captured.graph is not None and metrics["loss_objective"].isfinite()
