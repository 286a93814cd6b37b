"""What the tests of the pick-and-place environment share."""

import torch
from tensordict import TensorDict


def choose(env, td, actions) -> TensorDict:
    """Step, and return what came of it."""
    return env.step(td.set("action", torch.as_tensor(actions)))["next"]


def scenes(*numbers: int) -> TensorDict:
    return TensorDict({"scene": torch.tensor(numbers).unsqueeze(-1)}, batch_size=[len(numbers)])


def everything(td) -> dict:
    return dict(td.items(include_nested=True, leaves_only=True))


def assert_same(one, other) -> None:
    one, other = everything(one), everything(other)
    assert one.keys() == other.keys()
    assert all(torch.equal(one[key], other[key]) for key in one)
