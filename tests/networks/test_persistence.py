import json

import pytest
import torch
from safetensors.torch import save_file
from tensordict import TensorDict
from torch import nn

from ifo_grounding.errors import UserError
from ifo_grounding.networks import Shapes, load, make_policy, make_value, save
from ifo_grounding.networks.persistence import FORMAT
from networks.conftest import MAKERS, inputs


@pytest.fixture
def small():
    return Shapes((3, 24, 24), 9, instruction_length=4, n_actions=3, tile_size=8)


def nested_keys(kind, module):
    nested = [("agent", *([key] if isinstance(key, str) else key)) for key in module.in_keys]
    if kind == "policy":
        return {"in_keys": nested, "action_key": ("agent", "action"), "deterministic": True}
    return {"in_keys": nested, "out_key": ("agent", "out")}


def test_what_is_loaded_is_what_was_saved(kind, preset, small, tmp_path):
    options = nested_keys(kind, MAKERS[kind](small))
    module = MAKERS[kind](small, preset, features=16, head_hidden=(8, 8), seed=1, **options)
    save(module, tmp_path / "a.safetensors")
    again = load(tmp_path / "a.safetensors", kind=kind)
    assert type(again) is type(module)
    assert again.network_config == module.network_config
    assert (again.in_keys, again.out_keys) == (module.in_keys, module.out_keys)
    data = TensorDict({"agent": inputs(small, [3])}, [3]).select(*module.in_keys)
    first, second = module(data.clone()), again(data.clone())
    assert all(torch.equal(first[key], second[key]) for key in module.out_keys)
    assert not any(part.training for part in again.modules())


def test_training_travels(small, tmp_path):
    policy = make_policy(small, seed=0)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(torch.randn_like(parameter))
    save(policy, tmp_path / "a.safetensors")
    state = load(tmp_path / "a.safetensors").state_dict()
    assert all(torch.equal(state[name], value) for name, value in policy.state_dict().items())


def test_only_whole_files_appear(small, tmp_path):
    save(make_policy(small), tmp_path / "deep" / "a.safetensors")
    save(make_policy(small, seed=1), tmp_path / "deep" / "a.safetensors")
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.safetensors"]


def test_other_modules_cannot_be_saved(tmp_path):
    with pytest.raises(UserError, match="cannot save Linear"):
        save(nn.Linear(1, 1), tmp_path / "a.safetensors")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"a\.safetensors does not exist"):
        load(tmp_path / "a.safetensors")


@pytest.mark.parametrize("device", ["cdua", "xpu"])
def test_a_device_that_is_not_there_is_no_fault_of_the_file(small, tmp_path, device):
    save(make_policy(small), tmp_path / "a.safetensors")
    with pytest.raises(UserError, match=f"device={device} is none: use cpu"):
        load(tmp_path / "a.safetensors", device=device)


@pytest.mark.parametrize("cut", [0, 5, 500, -1])
def test_a_damaged_file_is_refused(small, tmp_path, cut):
    path = tmp_path / "a.safetensors"
    save(make_policy(small), path)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(UserError, match=r"a\.safetensors is damaged"):
        load(path)


def test_foreign_files_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    torch.save({"a": torch.zeros(1)}, path)
    with pytest.raises(UserError, match="damaged or no safetensors"):
        load(path)
    save_file({"a": torch.zeros(1)}, path, {"format": "ifo-grounding network 1"})
    with pytest.raises(
        UserError, match=r"no network of this version .*network 1'.* train it again"
    ):
        load(path)


def rewrite(path, change):
    """Write the file again with its metadata changed."""
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        content = json.loads(file.metadata()["network"])
    change(content, weights)
    save_file(weights, path, {"format": FORMAT, "network": json.dumps(content)})


CHANGES = {
    "another kind": lambda content, weights: content.update(kind="oracle"),
    "another size": lambda content, weights: content["config"].update(features=32),
    "a preset that is gone": lambda content, weights: content["config"].update(preset="film"),
    "an unknown option": lambda content, weights: content["config"].update(depth=2),
    "a missing weight": lambda content, weights: weights.popitem(),
    "a missing part": lambda content, weights: content.pop("shapes"),
    "no table": lambda content, weights: content.update(options=3),
    "another shape": lambda content, weights: content["shapes"].update(image_shape=[1, 48, 48]),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_mismatching_files_are_refused(small, tmp_path, change):
    path = tmp_path / "a.safetensors"
    save(make_policy(small, features=16), path)
    rewrite(path, change)
    with pytest.raises(UserError, match=r"a\.safetensors does not fit"):
        load(path)


def test_another_kind_than_asked_for_is_refused(small, tmp_path):
    save(make_value(small), tmp_path / "a.safetensors")
    with pytest.raises(UserError, match="holds a network of kind 'value', not 'policy'"):
        load(tmp_path / "a.safetensors", kind="policy")
