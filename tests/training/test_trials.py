import pytest
import torch

from ifo_grounding.data import labelled_buffer, record_demonstrations
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.training import FitConfig, Trial, fit, successive_halving
from training.tiny import make_policy, same, weights

CONFIG = FitConfig(steps=30, batch_size=16, lr=1e-2, iteration=5)


@pytest.fixture(scope="module")
def buffer():
    demos, truth = record_demonstrations("move", 8, seed=0, keep_truth=True)
    return labelled_buffer(demos, truth.actions)


def loss(number):
    policy = make_policy()
    torch.manual_seed(number)
    torch.nn.init.normal_(policy[0].module.out.bias, std=2.0 * number)  # the later, the worse
    return ImitationLoss(policy)


@pytest.fixture
def trial(buffer, tmp_path):
    def made(number):
        path = tmp_path / f"imitate-{number}.pt"
        return Trial(number, loss(number), buffer, CONFIG, path, seed=0, name="imitate")

    return made


def test_the_best_weights_learn_on_to_what_they_would_have_learned_alone(trial, buffer):
    best = successive_halving([trial(number) for number in (4, 2, 1, 3)], 10, halvings=1)
    assert best.number == 1
    logged = []
    history = best.finish(log=lambda metrics, step: logged.append(step))
    assert logged == [5, 10, 15, 20, 25, 30] == [metrics["step"] for metrics in history]
    alone = loss(1)
    expected = fit(alone, buffer, CONFIG, seed=0, name="imitate")
    assert [row["loss_imitation"] for row in history] == [row["loss_imitation"] for row in expected]
    assert same(weights(best.loss), weights(alone))


@pytest.mark.parametrize(
    ("count", "halvings", "steps"),
    [(1, 2, []), (4, 0, [10] * 4), (4, 1, [10] * 4 + [20] * 2), (3, 5, [10] * 3 + [20] * 2)],
)
def test_the_better_half_learns_on(monkeypatch, trial, count, halvings, steps):
    learned = []

    def learn(self, until):
        learned.append(until)
        return float(self.number)

    monkeypatch.setattr(Trial, "learn", learn)
    trials = [trial(number) for number in reversed(range(count))]
    assert successive_halving(trials, 10, halvings).number == 0
    assert learned == steps


def test_trials_that_were_killed_end_in_the_same_choice(trial):
    losses = [trial(number).learn(10) for number in range(2)]
    trial(0).finish()  # and the first one was killed after it had learned on
    again = [trial(number) for number in range(2)]
    assert [each.learn(10) for each in again] == losses
    assert again[0].learn(100) == again[0].learn(30)  # no more steps than there are
