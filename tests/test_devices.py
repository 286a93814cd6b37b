"""Everything takes a device: where there is no GPU, one is pretended."""

import pytest
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.collectors import Collector
from torchrl.envs import Compose, TransformedEnv

from ifo_grounding import data, networks
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.objectives import GoalLoss, ImitationLoss, InstructionLoss, InverseLoss
from ifo_grounding.training import AuxiliaryImitation, SelfExaminationConfig
from ifo_grounding.training.policy_gradient import Learner
from ifo_grounding.training.updates import total_loss
from ifo_grounding.transforms import InstructionSampler, LearnedReward
from ifo_grounding.transforms.choosing import PoolScorer
from pretended_gpu import pretended_gpu


def test_what_is_pretended_refuses_what_a_gpu_refuses(tmp_path):
    with pretended_gpu():
        there = torch.ones(3, device="cuda")
        layer = nn.Linear(3, 2).to("cuda")
        assert layer(there).device == layer.weight.device == there.device
        layer(there).sum().backward()
        assert layer.weight.grad.is_cuda
        torch.optim.Adam(layer.parameters(), fused=True).step()
        assert (there[torch.tensor([0, 2])] * torch.tensor(2)).is_cuda
        torch.save({"there": there}, tmp_path / "saved.pt")
        assert not torch.load(tmp_path / "saved.pt", map_location="cpu")["there"].is_cuda
        for wrong in (
            lambda: layer(torch.ones(3)),
            lambda: there + torch.ones(3),
            lambda: torch.ones(3)[torch.zeros(1, dtype=torch.int64, device="cuda")],
            lambda: torch.rand(3, device="cuda", generator=torch.Generator()),
            there.numpy,
        ):
            with pytest.raises((RuntimeError, TypeError), match=r"device|GPU"):
                wrong()
    assert torch.ones(3).device.type == "cpu"


def test_transforms_collect_on_a_gpu():
    demos = data.record_demonstrations("pick", 20, seed=0)
    with pretended_gpu():
        env = PickAndPlaceEnv("pick", num_envs=8, seed=0, device="cuda", instructed=False)
        classifier = networks.make_instruction_classifier(demos, device="cuda", seed=0)
        model = networks.make_reward_model(demos, device="cuda", seed=0)
        chooser = InstructionSampler(classifier, demos.pool(), threshold=0.0)
        env = TransformedEnv(env, Compose(chooser, LearnedReward(model)))
        policy = networks.make_policy(demos, device="cuda", seed=0)
        for batch in Collector(env, policy, frames_per_batch=64, total_frames=64, device="cuda"):
            assert batch["next", "learned_reward"].is_cuda
            assert batch["pixels"].is_cuda
        plain = PickAndPlaceEnv("pick", num_envs=8, seed=0, device="cuda", instructed=False)
        buffer, _ = data.collect_transitions(plain, 50, seed=0)
        assert len(buffer) > 0


def test_frames_of_a_gpu_become_demonstrations():
    demos = data.record_demonstrations("move", 3, seed=0)
    with pretended_gpu():
        frames = [demos[number]["pixels"].to("cuda") for number in range(3)]
        made = data.Demonstrations.from_arrays(frames, demos.sentences())
        assert torch.equal(made.frames(torch.arange(2)), frames[0][:2].cpu())
        which = torch.tensor([2, 0], device="cuda")
        assert torch.equal(made[which].first_frames()[0], frames[2][0].cpu())
        assert torch.equal(made[which].lengths, made.lengths[[2, 0]])


@pytest.mark.parametrize("preset", ["paper", "strong"])
@pytest.mark.parametrize("kind", ["instruction", "goal"])
def test_the_losses_of_pairs_are_the_same_on_a_gpu(kind, preset):
    """There neither distinct instructions nor final frames are looked for."""
    demos = data.record_demonstrations("move", 40, seed=0)
    pool = demos.pool()[:2]  # of two, the other one is drawn
    demos = demos[torch.nonzero((demos.tokens[:, None] == pool).all(-1).any(-1)).squeeze(1)]

    def losses(device):
        options = {"seed": 0, "device": device}
        if kind == "goal":
            network = networks.make_goal_classifier(demos, preset, **options)
            loss = GoalLoss(network, pool, negatives=1)
            batch = data.goal_buffer(demos)[:]
        else:
            network = networks.make_instruction_classifier(demos, preset, **options)
            loss = InstructionLoss(network, pool, unlabelled="mixture", near=0.5)
            batch = data.first_frame_buffer(demos)[:]
        out = loss.to(device).eval()(batch.to(device))
        return {name: float(value) for name, value in out.items()}

    here = losses("cpu")
    with pretended_gpu():
        assert losses("cuda") == pytest.approx(here, abs=1e-4)


WAITS = {"_local_scalar_dense", "nonzero", "is_nonzero", "equal", "unique", "_unique2"}
"""Operations by which a program waits for a GPU."""


class Asking(TorchDispatchMode):
    """Notes the operations that are called."""

    def __init__(self) -> None:
        super().__init__()
        self.noted: set[str] = set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.noted.add(function.overloadpacket.__name__)
        return function(*args, **(kwargs or {}))


def test_a_step_and_a_reset_ask_a_gpu_nothing():
    with pretended_gpu():
        simulator = PickAndPlaceEnv("pick", num_envs=8, seed=0, device="cuda")._simulator
        actions = torch.randint(6, (12, 8), device="cuda")
        simulator.reset()
        with Asking() as asking:
            for action in actions:
                _, terminated, truncated = simulator.step(action)
                simulator.pixels()
                simulator.reset(terminated | truncated)
    assert "where" in asking.noted and simulator.numbers.max() > 7
    assert not asking.noted & WAITS


def labelled(codes):
    """Return an environment, and demonstrations as it shows things."""
    demos, truth = data.record_demonstrations("pick", 20, seed=0, keep_truth=True)
    env, buffer = PickAndPlaceEnv(codes=codes), data.labelled_buffer(demos, truth.actions)
    if codes:
        data.show_codes(buffer, env.tiles)
    return env, buffer[:]


def test_codes_mean_the_same_on_a_gpu_which_looks_at_all_tiles():
    env, batch = labelled(codes=True)

    def losses(device):
        loss = ImitationLoss(networks.make_policy(env, seed=0, device=device))
        torch.manual_seed(0)
        words = loss(batch.to(device))["loss_words"]  # of the tiles that are shown
        return float(words), float(loss.eval()(batch.to(device))["loss_imitation"])

    here = losses("cpu")
    with pretended_gpu():
        assert losses("cuda") == pytest.approx(here, rel=0.01)


@pytest.mark.parametrize("codes", [False, True])
@pytest.mark.parametrize("preset", ["paper", "strong"])
def test_a_step_of_imitation_asks_a_gpu_nothing(preset, codes):
    env, batch = labelled(codes)
    with pretended_gpu():
        loss = ImitationLoss(networks.make_policy(env, preset, seed=0, device="cuda"))
        with Asking() as asking:
            total_loss(loss(batch.to("cuda"))).backward()
    assert "mm" in asking.noted or "addmm" in asking.noted
    assert not asking.noted & WAITS


@pytest.mark.parametrize("algorithm", ["ppo", "reinforce"])
@pytest.mark.parametrize("preset", ["paper", "strong"])
def test_a_step_of_practice_asks_a_gpu_nothing(preset, algorithm):
    demos, truth = data.record_demonstrations("move", 20, seed=0, keep_truth=True)
    buffer = data.labelled_buffer(demos, truth.actions)
    with pretended_gpu():
        buffer.transform.to("cuda")
        env = PickAndPlaceEnv("move", num_envs=8, seed=0, device="cuda")
        reward = LearnedReward(networks.make_reward_model(env, preset, seed=0, device="cuda"))
        policy = networks.make_policy(env, preset, seed=0, device="cuda").eval()
        value = networks.make_value(env, preset, seed=0, device="cuda", init_from=policy).eval()
        imitation = AuxiliaryImitation(ImitationLoss(policy), buffer, weight=0.1, batch_size=16)
        config = SelfExaminationConfig(algorithm, steps=4, minibatch=20, value_warmup=0, epochs=1)
        learner, asked = Learner(policy, value, config, imitation), []
        learner.prepare(cudagraph=True)
        captured = learner.captured

        def watched(batch):
            with Asking() as asking:
                metrics = captured(batch)
            asked.append(asking.noted)
            return metrics

        learner.captured = watched
        before = [weight.clone() for weight in policy.parameters()]
        with torch.no_grad():
            batch = TransformedEnv(env, reward).rollout(4, policy, break_when_any_done=False)
        metrics = learner.improve(batch, iteration=0)  # 32 steps: the last 12 are no graph
        moved = [not torch.equal(*pair) for pair in zip(before, policy.parameters(), strict=True)]
    assert len(asked) == 1 and "_fused_adamw_" in asked[0] and not asked[0] & WAITS
    assert all(moved) and metrics["loss_imitation"] > 0


def test_a_gpu_is_asked_once_whether_the_weights_of_a_classifier_changed():
    pool = data.record_demonstrations("pick", 20, seed=0).pool()
    with pretended_gpu():
        env = PickAndPlaceEnv("pick", num_envs=4, seed=0, device="cuda", codes=True)
        classifier = networks.make_instruction_classifier(env, device="cuda", seed=0)
        scorer = PoolScorer(classifier, pool)
        with torch.no_grad():
            before = scorer.words(torch.device("cuda", 0))
            with Asking() as asking:
                assert scorer.words(torch.device("cuda", 0)) is before
            assert "equal" not in asking.noted
            next(classifier.parameters()).data[0] += 1
            assert scorer.words(torch.device("cuda", 0)) is not before


@pytest.mark.parametrize("preset", ["paper", "strong"])
def test_a_step_of_the_instruction_classifier_asks_a_gpu_nothing(preset):
    demos = data.record_demonstrations("pick", 20, seed=0)
    batch = data.first_frame_buffer(demos)[:]
    with pretended_gpu():
        network = networks.make_instruction_classifier(demos, preset, seed=0, device="cuda")
        loss = InstructionLoss(network, demos.pool(), removal_rate=0.0).to("cuda")
        with Asking() as asking:
            total_loss(loss(batch.to("cuda"))).backward()
    assert not asking.noted & WAITS


@pytest.mark.parametrize("codes", [False, True])
def test_a_step_of_the_inverse_model_asks_a_gpu_nothing(codes):
    env = PickAndPlaceEnv(num_envs=4, codes=codes, seed=0)
    batch = env.rollout(5, break_when_any_done=False).reshape(-1)
    with pretended_gpu():
        loss = InverseLoss(networks.make_inverse(env, seed=0, device="cuda"))
        with Asking() as asking:
            total_loss(loss(batch.to("cuda"))).backward()
    assert not asking.noted & WAITS
