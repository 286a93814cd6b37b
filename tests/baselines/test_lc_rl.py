"""LC-RL: exact planning over the arm's cells, and a reward that makes demonstrations likely."""

import math

import pytest
import torch

from ifo_grounding.baselines import LCRL, SteppableActionDemonstrations, SteppableDemonstrations
from ifo_grounding.baselines.lc_rl import CHOICES, neighbours, soft_values, walk
from ifo_grounding.data import Truth, record_demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.keys import STOP
from ifo_grounding.worlds import Grid


@pytest.fixture(scope="module")
def seen():
    demos, truth = record_demonstrations("move", 24, seed=1, keep_truth=True)
    steps = SteppableDemonstrations(demos, Grid("move").steppable(8, seed=1))
    return SteppableActionDemonstrations(steps, truth)


def test_soft_values_by_hand():
    # Two cells in a row of one; one move at most, and then the stop.
    moves = torch.tensor([[0, 1, 0, 0], [1, 1, 1, 0]])
    reward = torch.tensor([0.0, 2.0])
    weights = [[1.0, math.exp(2.0), 1.0, 1.0, 1.0], [math.exp(2.0)] * 3 + [1.0, math.exp(2.0)]]
    expected = torch.tensor([[w / sum(row) for w in row] for row in weights])
    torch.testing.assert_close(soft_values(reward, moves, 1).exp(), expected)


def test_the_greedy_plan_goes_to_the_goal_on_a_shortest_path():
    reward = torch.full((36,), -20.0)
    reward[27] = 20.0
    plan, moves = soft_values(reward, neighbours(6), 12).argmax(-1), neighbours(6)
    for cell in range(36):
        steps = abs(cell // 6 - 27 // 6) + abs(cell % 6 - 27 % 6)
        for _ in range(steps):
            assert plan[cell] < 4
            cell = int(moves[cell, plan[cell]])
        assert cell == 27 and plan[cell] == CHOICES.index(STOP)


def test_a_walk_shows_every_cell_in_its_place(seen):
    env = Grid("move").instructed(8, seed=1, stream="training")
    frames, instruction = walk(env, torch.arange(8), 6)
    state = env.reset(env.reset().empty().set("scene", torch.arange(8).unsqueeze(-1)))
    arm = env.truth.state.arm
    assert torch.equal(frames[torch.arange(8), arm.long()], state["pixels"])
    assert torch.equal(instruction, state["instruction"])
    assert all(len(scene.flatten(1).unique(dim=0)) == 36 for scene in frames)


def test_cells_of_demonstrations_are_found_by_their_frames(seen):
    planner = LCRL(seen, features=8, seed=0)
    moves, (episode, _) = neighbours(6), seen.demos.locate()
    for place in range(len(episode) - 1):
        if episode[place] == episode[place + 1]:
            cell, choice = planner.cells[place], planner.choice[place]
            assert moves[cell, choice] == planner.cells[place + 1]


def test_it_learns_where_to_stop(seen):
    planner, again = (LCRL(seen, lr=3e-3, features=16, seed=0) for _ in range(2))
    first = planner.learn(1, batch_size=8)["loss_likelihood"]
    torch.manual_seed(1)
    assert again.learn(1, batch_size=8)["loss_likelihood"] == first  # whatever was drawn before
    planner.learn(30, batch_size=8)
    last = planner.learn(1, batch_size=8)["loss_likelihood"]
    assert first == pytest.approx(math.log(5), abs=0.3)  # at first as good as chance
    assert last < 0.8
    trained = planner.success(seen.steps.env, 24)
    assert trained.float().mean() > 0.6


def test_it_takes_moves_of_demonstrations_alone(seen):
    with pytest.raises(UserError, match="no more and no less"):
        LCRL(seen.steps)
    more = seen.truth.actions.clone()
    more[0] = 4
    with pytest.raises(UserError, match="did more"):
        LCRL(SteppableActionDemonstrations(seen.steps, Truth(more)))
