import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from safetensors.torch import save as serialize
from tensordict import TensorDict
from torch import nn

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import success_rate
from ifo_grounding.networks import (
    Shapes,
    from_pretrained,
    load,
    make_inverse,
    make_policy,
    save,
    save_pretrained,
)
from ifo_grounding.networks.saving import FORMAT
from ifo_grounding.tasks import TASKS, VOCABULARY, Vocabulary
from networks.conftest import MAKERS, inputs, nested_keys

SHAPES = Shapes((3, 16, 16), len(VOCABULARY), n_actions=3, tile_size=8)


@pytest.fixture
def path(tmp_path):
    """Return where a policy is saved."""
    save(make_policy(SHAPES, features=16), tmp_path / "a.safetensors")
    return tmp_path / "a.safetensors"


@pytest.fixture
def mine(tmp_path):
    """Return the folder of a policy and its words."""
    return save_pretrained(speaking(VOCABULARY), tmp_path / "mine")


def speaking(words):
    """Return a policy of some words."""
    policy = make_policy(SHAPES)
    policy.vocabulary = words
    return policy


def rewrite(path, change):
    """Change what a file says of its network, without a checksum, and its weights."""
    with safe_open(path, "pt") as file:
        weights, content = load_file(path), json.loads(file.metadata()["network"])
    change(content, weights)
    save_file(weights, path, {"format": FORMAT, "network": json.dumps(content)})


def test_what_is_loaded_is_what_was_saved(kind, preset, tmp_path):
    keys = nested_keys(MAKERS[kind](SHAPES))
    if kind == "policy":
        keys["deterministic"] = True
    module = MAKERS[kind](SHAPES, preset, features=16, head_hidden=(8, 8), seed=1, **keys)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(torch.randn_like(parameter))
    for _ in range(2):
        save(module, tmp_path / "deep" / "a.safetensors")
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.safetensors"]
    again = load(tmp_path / "deep" / "a.safetensors", kind=kind)
    assert type(again) is type(module)
    assert again.network_config == module.network_config
    assert (again.in_keys, again.out_keys) == (module.in_keys, module.out_keys)
    data = TensorDict({"agent": inputs(SHAPES, [3])}, [3]).select(*module.in_keys)
    first, second = module(data.clone()), again(data.clone())
    assert all(torch.equal(first[key], second[key]) for key in module.out_keys)
    assert not any(part.training for part in again.modules())


def test_other_modules_cannot_be_saved(tmp_path):
    for write in (save, save_pretrained):
        with pytest.raises(UserError, match="cannot save Linear: only what a make_"):
            write(nn.Linear(1, 1), tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_line_and_keeps_the_network_before(path, monkeypatch):
    before, full = path.read_bytes(), Mock(side_effect=SafetensorError("No space left on device"))
    monkeypatch.setattr("ifo_grounding.networks.saving.save_file", full)
    with pytest.raises(UserError, match=r"a\.safetensors cannot be written .* make room"):
        save(make_policy(SHAPES), path)
    assert path.read_bytes() == before


def test_missing_damaged_and_foreign_files_and_devices_are_refused(path):
    for device in ("cdua", "xpu"):
        with pytest.raises(UserError, match=f"device={device} is none: use cpu"):
            load(path, device=device)
    contents = [path.read_bytes()[:cut] for cut in (0, 5, 500, -1)]
    for network in ("[1]", "3", "[" * 100_000, "9" * 5_000):
        contents.append(serialize({"a": torch.zeros(1)}, {"format": FORMAT, "network": network}))
    for content in contents:
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"a\.safetensors is damaged, another"):
            load(path)
    save_file({"a": torch.zeros(1)}, path, {"format": "ifo-grounding network 1"})
    with pytest.raises(UserError, match=r"no network of this version .*network 1'.* it again"):
        load(path)
    path.unlink()
    with pytest.raises(UserError, match=r"a\.safetensors does not exist"):
        load(path)
    os.mkfifo(path)
    with pytest.raises(UserError, match="no regular file"):
        load(path)


def test_a_weight_or_a_word_that_changed_is_refused(mine):
    path = mine / "network.safetensors"
    whole = path.read_bytes()
    for damaged in (whole[:-1] + bytes([whole[-1] ^ 1]), whole.replace(b"circle", b"cirdle")):
        path.write_bytes(damaged)
        with pytest.raises(UserError, match="by its checksum, it is not what was saved"):
            from_pretrained(mine)


def test_another_network_and_one_without_numbers_are_refused(path):
    policy = make_policy(SHAPES, seed=1)
    checksum = save(policy, path)
    assert save(load(path, checksum=checksum), path) == checksum
    save(make_policy(SHAPES, seed=2), path)
    with pytest.raises(UserError, match=r"another network .* delete it and train again"):
        load(path, checksum=checksum)
    next(policy.parameters()).data.fill_(torch.nan)
    save(policy, path)
    with pytest.raises(UserError, match="weights are not finite"):
        load(path)


CHANGES = {
    "a vocabulary of millions": lambda content, _: content["shapes"].update(vocabulary_size=10**7),
    "a number too large": lambda content, _: content["shapes"].update(vocabulary_size=10**30),
    "a large image": lambda content, _: content["shapes"].update(image_shape=[3, 10**5, 10**5]),
    "features": lambda content, _: content["config"].update(features=10**9),
    "layers without end": lambda content, _: content["config"].update(context=10**9),
    "another kind": lambda content, weights: content.update(kind="oracle"),
    "another size": lambda content, weights: content["config"].update(features=32),
    "a preset that is gone": lambda content, weights: content["config"].update(preset="film"),
    "an unknown option": lambda content, weights: content["config"].update(depth=2),
    "a missing weight": lambda content, weights: weights.popitem(),
    "a missing part": lambda content, weights: content.pop("shapes"),
    "no table": lambda content, weights: content.update(options=3),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_mismatching_files_are_refused_before_they_take_memory(path, change, monkeypatch):
    def make(*args, device, **options):
        assert device == "meta"
        return make_policy(*args, device=device, **options)

    rewrite(path, change)
    monkeypatch.setitem(MAKERS, "policy", make)
    with pytest.raises(UserError, match=r"a\.safetensors does not fit"):
        load(path)


def test_a_file_without_a_checksum_that_names_a_precision_is_read(path):
    before = load(path)
    rewrite(path, lambda content, _: content["config"].update(precision=None))
    assert load(path).network_config == before.network_config


def test_words_are_kept_when_a_network_is_saved_again(mine, tmp_path):
    save(make_policy(PickAndPlaceEnv("move")), tmp_path / "a.safetensors")
    assert load(tmp_path / "a.safetensors").vocabulary == VOCABULARY
    again = from_pretrained(mine)
    assert again.vocabulary == VOCABULARY
    assert from_pretrained(save_pretrained(again, tmp_path / "again")).vocabulary == VOCABULARY
    again.vocabulary = fewer = Vocabulary(VOCABULARY.words[:5])
    assert from_pretrained(save_pretrained(again, tmp_path / "again")).vocabulary == fewer


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (Vocabulary([*VOCABULARY.words, "fly"]), "has 49 token ids .* built for 48 and 16"),
        (Vocabulary(VOCABULARY.words, length=9), "and 9 per instruction, .* for 48 and 16"),
    ],
)
def test_words_that_do_not_fit_or_are_damaged_are_refused(mine, words, said):
    with pytest.raises(UserError, match=f"the vocabulary .*{said}"):
        save_pretrained(speaking(words), mine / "other")
    assert not (mine / "other").exists()
    for content in (asdict(words), [1], {}, 3, {"words": [1], "length": 16}, {"words": 3}):
        told = {"vocabulary": content}
        rewrite(mine / "network.safetensors", lambda plan, _, told=told: plan.update(told))
        with pytest.raises(UserError, match=r"safetensors does not fit this version"):
            from_pretrained(mine)


def test_links_are_replaced_and_pipes_not_waited_for(tmp_path):
    folder, names = tmp_path / "mine", ("network.safetensors", "README.md")
    folder.mkdir()
    for name in names:
        (tmp_path / name).write_text("library_name: ifo-grounding")
        (folder / name).symlink_to(tmp_path / name)
    save_pretrained(make_policy(SHAPES), folder)
    assert {(tmp_path / name).read_text() for name in names} == {"library_name: ifo-grounding"}
    (folder / "README.md").unlink()
    os.mkfifo(folder / "README.md")
    assert from_pretrained(save_pretrained(make_policy(SHAPES), folder)).vocabulary is None


def test_other_files_of_a_folder_stay(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = {"thesis.tex": "chapter 1", ".git/HEAD": "ref: refs/heads/main", "README.md": "# Mine"}
    for name, text in kept.items():
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)
    assert save_pretrained(make_policy(SHAPES), ".") == Path()
    assert {name: Path(name).read_text() for name in kept} == kept
    there = {"network.safetensors", "thesis.tex", ".git", "README.md"}
    assert {path.name for path in Path().iterdir()} == there


def test_a_network_takes_the_place_of_another(mine):
    facts = {"Task": "move", "phase 2 success": "99.7% [99.5, 99.8]", "Command": "`make demo`"}
    odd = {"Level|\nof mine": "a|b\nc \ud800"}
    save_pretrained(make_inverse(SHAPES), mine, facts={**facts, **odd})
    assert sorted(path.name for path in mine.iterdir()) == ["README.md", "network.safetensors"]
    assert from_pretrained(mine).vocabulary is None
    with pytest.raises(UserError, match="'inverse', not 'policy'"):
        from_pretrained(mine, kind="policy")
    card = (mine / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: ifo-grounding\n")
    for shown in ("names the action", "| Preset | strong |", "3x16x16", *facts.values()):
        assert shown in card
    assert r"| Level\| of mine | a\|b c |" in card


def test_what_cannot_be_shared_or_found_is_said(mine, tmp_path, monkeypatch):
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for name in ("mine/README.md", "link", "mine/README.md/below"):
        with pytest.raises(UserError, match=f"{name} is no folder and cannot be made one"):
            save_pretrained(make_policy(SHAPES), tmp_path / name)
    for missing in (tmp_path / "missing", "missing", mine / "network.safetensors"):
        with pytest.raises(UserError, match=r"no folder .* user/name"):
            from_pretrained(missing)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="runs/policy is neither a folder nor a repository"):
        from_pretrained("runs/policy")
    with pytest.raises(UserError, match=r"neither a folder .*HFValidationError"):
        from_pretrained("some--one/policy")
    with pytest.raises(UserError, match=r"a/policy could not be sent .*hf auth login"):
        save_pretrained(make_policy(SHAPES), mine, hub_id="a/policy")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(UserError, match=r"ifo-grounding\[hub\]"):
        from_pretrained("someone/something")


def test_the_hub_gets_the_folder_in_one_commit(tmp_path, monkeypatch):
    sent = {}

    def upload(api, *, folder_path, repo_id, allow_patterns, commit_message=""):
        files = {path.name: path.read_bytes() for path in Path(folder_path).iterdir()}
        assert set(allow_patterns) >= set(files)
        sent.update(repo_id=repo_id, commit_message=commit_message, files=files)

    def create(api, repo_id, **options):
        sent["created"] = options
        return SimpleNamespace(repo_id=repo_id)

    monkeypatch.setattr("huggingface_hub.HfApi.create_repo", create)
    monkeypatch.setattr("huggingface_hub.HfApi.upload_folder", upload)
    policy, to = make_policy(SHAPES, seed=0), {"hub_id": "a/policy"}
    save_pretrained(policy, tmp_path, **to, private=True, commit_message="first")
    assert sent["files"] == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert sent["repo_id"] == "a/policy" and sent["commit_message"] == "first"
    assert sent["created"] == {"private": True, "exist_ok": True}
    with pytest.raises(TypeError, match="privat"):
        save_pretrained(policy, tmp_path, **to, privat=True)


@pytest.mark.parametrize("task", TASKS)
def test_networks_that_come_with_the_package_do_their_task(task):
    policy = from_pretrained(f"ifo-grounding/{task}")
    env = PickAndPlaceEnv(task, num_envs=200)
    assert success_rate(policy, env, episodes=200, seed=0, stream="validation").rate.rate > 0.95
    for kind in ("instruction", "goal"):
        network = from_pretrained(f"ifo-grounding/{task}", kind=kind)
        assert network.network_config.kind == kind and network.vocabulary == policy.vocabulary


def test_networks_that_do_not_come_with_the_package_are_named():
    with pytest.raises(UserError, match=r"unknown network .*choose one of 'ifo-grounding/move', "):
        from_pretrained("ifo-grounding/fly")
    with pytest.raises(UserError, match=r"unknown kind of .* 'value': choose one of 'goal', 'ins"):
        from_pretrained("ifo-grounding/move", kind="value")
