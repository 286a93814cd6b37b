"""Rivals of Table 1: what each may use, what its discriminator learns and pays."""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from ifo_grounding import networks
from ifo_grounding.baselines import (
    AGILE,
    GAIL,
    AbsorbingState,
    ActionDemonstrations,
    ChangeNetwork,
    ChosenAGILE,
    DiscriminatorLoss,
    DiscriminatorReward,
    GAIfO,
    SteppableDemonstrations,
    StopReward,
    adversarial,
    steps_of_policy,
)
from ifo_grounding.config import SelfExamineConfig
from ifo_grounding.data import record_demonstrations
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.keys import STOP
from ifo_grounding.networks import make_policy
from ifo_grounding.training.reseeding import reseed
from ifo_grounding.worlds import Grid, World

SMALL = {"features": 8, "seed": 0}


@pytest.fixture(scope="module")
def sources():
    demos, truth = record_demonstrations("move", 12, seed=3, keep_truth=True)
    steppable = SteppableDemonstrations(demos, Grid("move").steppable(5, seed=3))
    return {
        "frames": demos,
        "actions": ActionDemonstrations(demos, truth),
        "steps": steppable,
    }


@pytest.mark.parametrize(
    ("method", "allowed"),
    [(GAIL, "actions"), (GAIfO, "frames"), (AGILE, "steps"), (ChosenAGILE, "frames")],
)
def test_a_method_uses_its_row_of_table_1_no_more_and_no_less(method, allowed, sources):
    assert method(sources[allowed], **SMALL).network is not None
    for name, source in sources.items():
        if name != allowed:
            with pytest.raises(UserError, match="no more and no less"):
                method(source, **SMALL)


def test_only_those_that_may_see_actions_hold_any(sources):
    held = {
        method: set(method(sources[name], **SMALL).demonstrations[:].keys(True, True))
        for method, name in ((GAIL, "actions"), (GAIfO, "frames"), (AGILE, "steps"))
    }
    assert "action" in held[GAIL]
    assert "action" not in held[GAIfO] | held[AGILE]
    truth = sources["actions"].truth.actions
    assert torch.equal(GAIL(sources["actions"], **SMALL).demonstrations[:]["action"], truth.long())


def test_agile_reads_last_frames_alone(sources):
    shown = AGILE(sources["steps"], **SMALL).demonstrations[:]
    demos = sources["frames"]
    last = demos.frames(demos.starts + demos.lengths - 1)
    assert torch.equal(shown["next", "pixels"], last)
    assert torch.equal(shown["instruction"], demos.instructions.long())


def test_episodes_begin_where_demonstrations_do(sources):
    env = sources["steps"].starts(seed=1)
    reseed(env, 5)  # as before each iteration
    firsts = sources["frames"].frames(sources["frames"].starts)
    rollout = env.rollout(60, break_when_any_done=False)
    begun = torch.cat(
        [torch.ones(5, 1, dtype=torch.bool), rollout["next", "done"].squeeze(-1)[:, :-1]], 1
    )
    shown = rollout["pixels"][begun]
    same = (shown.unsqueeze(1) == firsts).flatten(2).all(-1)
    assert len(shown) > 5 and same.any(1).all()
    said = sources["frames"].instructions.long()[same.int().argmax(1)]
    assert torch.equal(rollout["instruction"][begun], said)


def test_another_simulator_is_refused(sources):
    with pytest.raises(UserError, match="does not begin as demonstrations"):
        SteppableDemonstrations(sources["frames"], Grid("move").steppable(5, seed=4))
    for index in ([0, 1], [0, 1, 2, 3, 12], [-1, 0, 1, 2, 3]):
        with pytest.raises(UserError, match="number of one of 12 demonstrations"):
            sources["steps"].reset(index)


def test_a_world_that_cannot_go_back_says_so():
    with pytest.raises(UserError, match="cannot begin where a demonstration began"):
        World.steppable(Grid("move"), 2, seed=0)


def steps(*logits, said=None):
    said = said or [[1]] * len(logits)
    return TensorDict(
        {"x": torch.tensor(logits).unsqueeze(-1), "instruction": torch.tensor(said)}, [len(logits)]
    )


def scorer():
    """Score x, and 10 less where the instruction is 2."""
    return TensorDictModule(lambda x, said: x - 10.0 * (said == 2), ["x", "instruction"], ["logit"])


def softplus(x):
    return math.log1p(math.exp(x))


def test_the_loss_by_hand():
    found = DiscriminatorLoss(scorer())(steps(1.0, 3.0), steps(-1.0, 0.0, 2.0, 4.0))
    right = (softplus(-1) + softplus(-3)) / 2
    wrong = sum(map(softplus, (-1, 0, 2, 4))) / 4
    assert found["loss_discriminator"].item() == pytest.approx((right + wrong) / 2, rel=1e-5)
    assert found["demonstrated_probability"].item() == pytest.approx(
        (1 / (1 + math.exp(-1)) + 1 / (1 + math.exp(-3))) / 2, rel=1e-5
    )


def test_the_likeliest_of_the_policys_are_spared():
    found = DiscriminatorLoss(scorer(), spare=0.5)(steps(1.0), steps(4.0, -1.0, 2.0, 0.0))
    wrong = (softplus(-1) + softplus(0)) / 2
    expected = (softplus(-1) + wrong) / 2
    assert found["loss_discriminator"].item() == pytest.approx(expected, rel=1e-5)
    with pytest.raises(UserError, match="spare"):
        DiscriminatorLoss(scorer(), spare=1.0)  # none would be left


def test_steps_of_a_policy_are_a_function_of_the_seed():
    demos = record_demonstrations("move", 4, seed=0)
    policy = make_policy(demos, seed=0)

    def steps_after(seed):
        torch.manual_seed(seed)
        env = PickAndPlaceEnv("move", num_envs=4, seed=0, instructed=False)
        return steps_of_policy(env, policy, demos.pool(), 40, seed=0).report.taken

    assert torch.equal(steps_after(1), steps_after(2))


def test_demonstrations_with_another_instruction_are_negatives():
    loss = DiscriminatorLoss(scorer(), swapped=True)
    found = loss(steps(1.0, 3.0, 3.0, said=[[1], [2], [2]]), steps(0.0))
    # Row 0 is given 2, row 1 is given 1; row 2 would be given its own.
    right = (softplus(-1) + softplus(7) + softplus(7)) / 3
    elsewhere = (softplus(1 - 10) + softplus(3)) / 2
    wrong = (softplus(0) + elsewhere) / 2
    assert found["loss_discriminator"].item() == pytest.approx((right + wrong) / 2, rel=1e-5)
    alike = loss(steps(1.0, 3.0), steps(0.0))  # nothing to swap with
    assert "swapped_probability" not in set(alike.keys())


def paid_steps():
    """Three steps, a network that scores how bright they get, and what they led to."""

    def brightness(pixels, _):
        return pixels.float().mean((-3, -2, -1)).unsqueeze(-1) - 1.0

    keys_read = [("next", "pixels"), "instruction"]
    model = TensorDictModule(brightness, keys_read, ["logit"])
    before = TensorDict(
        {"instruction": torch.ones(3, 2).long(), "action": torch.tensor([STOP, STOP, 0])}, [3]
    )
    bright = torch.tensor([3, 0, 3], dtype=torch.uint8).view(3, 1, 1, 1).expand(3, 3, 8, 8)
    ended = torch.tensor([[True], [True], [False]])
    return model, before, TensorDict({"pixels": bright, "terminated": ended}, [3])


def test_a_stop_is_paid_the_verdict():
    model, before, after = paid_steps()
    assert StopReward(model, STOP).pay(before, after).tolist() == [[1.0], [0.0], [0.0]]


def test_every_step_is_paid_its_logit_and_an_end_what_the_absorbing_state_pays():
    model, before, after = paid_steps()
    state = AbsorbingState(3.0, gamma=0.5)
    reward = DiscriminatorReward(model, state)
    assert reward.pay(before, after).tolist() == [[2.0], [-1.0], [2.0]]  # nothing is counted yet
    done = torch.tensor([[False, True, False, False], [False, False, False, True]]).unsqueeze(-1)
    state.count(TensorDict({"next": {"done": done}}, [2, 4]))
    own = 1 + 1 + 2 / 3 + 2 / 3  # two of three that reach the second step go on, one to the fourth
    step = math.log((1 - 1 / 8) / (1 - 0.5**own))
    end = sum(0.5**later * math.log((1 / 8) / 0.5**own) for later in range(1, 60))
    expected = [[2 + step + end], [-1 + step + end], [2 + step]]
    torch.testing.assert_close(reward.pay(before, after), torch.tensor(expected))


@pytest.mark.parametrize("length", [2, 5, 9, 40])
def test_episodes_as_long_as_demonstrations_are_paid_logits_alone(length):
    done = torch.arange(1, 65).remainder(length).eq(0).view(1, -1, 1)  # the last one is cut off
    state = AbsorbingState(float(length), gamma=0.95)
    state.count(TensorDict({"next": {"done": done}}, [1, 64]))
    torch.testing.assert_close(torch.stack([state.step, state.end]), torch.zeros(2))


def test_the_reward_of_a_step_is_that_of_what_it_led_to(sources):
    adversary = GAIfO(sources["frames"], **SMALL)
    env = sources["steps"].starts(seed=2).append_transform(adversary.reward)
    rollout = env.rollout(6, break_when_any_done=False)
    logits = adversary.network(rollout.reshape(-1))["change_score"]
    paid = rollout["next", "learned_reward"].reshape(-1, 1)
    torch.testing.assert_close(paid, logits, rtol=1e-4, atol=1e-4)


def test_a_change_is_scored_as_the_kind_that_it_looks_like():
    class Kinds(torch.nn.Module):
        def all_actions(self, before, said):
            return torch.tensor([[2.0, -4.0, 7.0]]) * before * said

    def inverse(before, after):
        return torch.stack([after, -after, 9.0 * before.squeeze(-1)], -1)

    before, after, said = torch.full((2, 1), 3.0), torch.full((2,), math.log(2)), torch.tensor(0.5)
    ended = torch.tensor([[False], [True]])
    scored = ChangeNetwork(inverse, Kinds(), stop=2)(before, after, ended, said)
    # Odds of 4 to 1 for the first kind, whose score is 3, of the other -6; the end's is 10.5.
    torch.testing.assert_close(scored, torch.tensor([[0.8 * 3 - 0.2 * 6], [10.5]]))
    scored = ChangeNetwork(inverse, Kinds(), stop=0)(before, after, ended, said)
    torch.testing.assert_close(scored, torch.tensor([[10.5], [3.0]]))  # all else is the third kind
    scored = ChangeNetwork(inverse, Kinds(), stop=None)(before, after, ended, said)
    torch.testing.assert_close(scored, torch.tensor([[10.5], [10.5]]))


@pytest.mark.parametrize("method", [GAIL, GAIfO])
def test_a_discriminator_is_built_for_the_actions_of_its_world(method, sources):
    seen, shapes = sources["frames"], networks.Shapes.of(sources["frames"])
    source = sources["actions"] if method is GAIL else seen
    adversary = method(source, shapes=replace(shapes, n_actions=7), **SMALL)
    sizes = {
        part.shapes.n_actions
        for part in adversary.network.modules()
        if isinstance(part, networks.base.ImageNetwork)
    }
    assert sizes == {7}


@pytest.mark.parametrize("name", ["actions", "frames", "steps"])
def test_updates_tell_demonstrations_from_the_policy(name, sources):
    method = {"actions": GAIL, "frames": GAIfO, "steps": AGILE}[name]
    torch.manual_seed(0)
    how = {"steps": 20, "lr": 1e-2, "batch_size": 32, "prior": 0.0}
    adversary = method(sources[name], features=16, seed=0, **how)
    batch = sources["steps"].starts(seed=2).rollout(12, break_when_any_done=False)
    metrics = adversary(batch)
    assert not adversary.network.training
    later = adversary(batch)
    gap = later["reward/demonstrated_probability"] - later["reward/policy_probability"]
    assert gap > 0.5 and later["reward/loss_discriminator"] < metrics["reward/loss_discriminator"]
    assert adversary.probability(sources[name]) > 0.7 > later["reward/policy_probability"]


def test_episodes_that_do_not_end_are_as_long_as_what_is_collected():
    state = AbsorbingState(3.0, gamma=0.5)
    state.count(TensorDict({"next": {"done": torch.zeros(2, 5, 1, dtype=torch.bool)}}, [2, 5]))
    assert float(state.end) == pytest.approx((5 - 3) * math.log(2), rel=1e-5)
    for gamma in (0.0, 1.0):
        with pytest.raises(UserError, match="gamma must be above 0 and below 1"):
            AbsorbingState(3.0, gamma)


def test_fewer_demonstrations_count_less_than_the_prior(sources):
    adversary = GAIfO(sources["frames"], prior=600.0, **SMALL)
    assert [group["weight_decay"] for group in adversary.optimizer.param_groups] == [50.0]


def test_an_inverse_model_decays_towards_what_it_was(sources):
    inverse = networks.make_inverse(sources["frames"], **SMALL)
    begun = [weight.detach().clone() for weight in inverse.parameters()]
    how = {"prior": 600.0, "lr": 1e-3, "steps": 60, **SMALL}
    adversary = GAIfO(sources["frames"], inverse=inverse, **how)
    adversary(sources["steps"].starts(seed=2).rollout(12, break_when_any_done=False))
    moved = [now - then for now, then in zip(inverse.parameters(), begun, strict=True)]
    norms = [torch.cat([weight.flatten() for weight in of]).norm() for of in (moved, begun)]
    assert 0 < norms[0] < norms[1] / 2  # of themselves they would have lost 95%


def test_windows_hold_as_many_frames_as_those_of_phase_2():
    phase2 = SelfExamineConfig(num_envs=20, steps=16, lr=0.5)
    practice = GAIL.practice(phase2)
    assert (practice.num_envs, practice.steps, practice.lr) == (5, 64, 0.5)
    assert AGILE.practice(phase2) == phase2


def test_a_method_has_a_learning_rate_of_its_own(sources, monkeypatch):
    def rate_of(**given):
        return GAIfO(sources["frames"], **SMALL, **given).optimizer.param_groups[0]["lr"]

    assert (rate_of(), rate_of(lr=0.5)) == (3e-4, 0.5)
    monkeypatch.setattr(adversarial, "FEW", len(sources["frames"]))
    assert (rate_of(), rate_of(lr=0.5)) == (1e-3, 0.5)
    assert GAIL(sources["actions"], **SMALL).optimizer.param_groups[0]["lr"] == 1e-3


def test_agile_needs_a_stop(sources):
    with pytest.raises(UserError, match="paid at the stop"):
        AGILE(sources["steps"], stop_action=None, **SMALL)
