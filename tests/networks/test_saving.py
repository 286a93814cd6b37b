import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from tensordict import TensorDict
from torch import nn

from ifo_grounding.errors import UserError
from ifo_grounding.files import write_json
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
from ifo_grounding.tasks import VOCABULARY, Vocabulary
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
    return save_pretrained(make_policy(SHAPES), tmp_path / "mine", vocabulary=VOCABULARY)


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


def test_a_device_that_is_not_there_is_no_fault_of_the_file(path):
    for device in ("cdua", "xpu"):
        with pytest.raises(UserError, match=f"device={device} is none: use cpu"):
            load(path, device=device)


def test_missing_damaged_and_foreign_files_are_refused(path):
    whole = path.read_bytes()
    for cut in (0, 5, 500, -1):
        path.write_bytes(whole[:cut])
        with pytest.raises(UserError, match=r"a\.safetensors is damaged or no safetensors"):
            load(path)
    save_file({"a": torch.zeros(1)}, path, {"format": "ifo-grounding network 1"})
    with pytest.raises(
        UserError, match=r"no network of this version .*network 1'.* train it again"
    ):
        load(path)
    path.unlink()
    with pytest.raises(UserError, match=r"a\.safetensors does not exist"):
        load(path)


CHANGES = {
    "another kind": lambda content, weights: content.update(kind="oracle"),
    "another size": lambda content, weights: content["config"].update(features=32),
    "a preset that is gone": lambda content, weights: content["config"].update(preset="film"),
    "an unknown option": lambda content, weights: content["config"].update(depth=2),
    "a missing weight": lambda content, weights: weights.popitem(),
    "a missing part": lambda content, weights: content.pop("shapes"),
    "no table": lambda content, weights: content.update(options=3),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_mismatching_files_are_refused(path, change):
    with safe_open(path, "pt") as file:
        weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        content = json.loads(file.metadata()["network"])
    change(content, weights)
    save_file(weights, path, {"format": FORMAT, "network": json.dumps(content)})
    with pytest.raises(UserError, match=r"a\.safetensors does not fit"):
        load(path)


def test_words_are_kept_when_a_network_is_saved_again(mine, tmp_path):
    assert from_pretrained(mine).vocabulary == VOCABULARY
    save_pretrained(from_pretrained(mine), tmp_path / "again")
    assert from_pretrained(tmp_path / "again").vocabulary == VOCABULARY
    fewer = Vocabulary(VOCABULARY.words[:5])
    save_pretrained(from_pretrained(mine), tmp_path / "again", vocabulary=fewer)
    assert from_pretrained(tmp_path / "again").vocabulary == fewer


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (Vocabulary([*VOCABULARY.words, "fly"]), "has 49 token ids .* built for 48 and 16"),
        (Vocabulary(VOCABULARY.words, length=9), "and 9 per instruction, .* for 48 and 16"),
    ],
)
def test_words_that_do_not_fit_are_refused(mine, words, said):
    with pytest.raises(UserError, match=f"the vocabulary .*{said}"):
        save_pretrained(make_policy(SHAPES), mine / "other", vocabulary=words)
    assert not (mine / "other").exists()
    write_json(mine / "vocabulary.json", {"words": words.words, "length": words.length})
    with pytest.raises(UserError, match=rf"vocabulary\.json .*{said}"):
        from_pretrained(mine)


def test_damaged_words_are_refused(mine):
    for content in ([1], {}, None, {"words": [1], "length": 16}, {"words": 3}):
        write_json(mine / "vocabulary.json", content)
        with pytest.raises(UserError, match=r"vocabulary\.json holds no words"):
            from_pretrained(mine)


def test_other_files_of_a_folder_stay(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = {"thesis.tex": "chapter 1", ".git/HEAD": "ref: refs/heads/main", "README.md": "# Mine"}
    for name, text in kept.items():
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)
    assert save_pretrained(make_policy(SHAPES), ".", vocabulary=VOCABULARY) == Path()
    assert {name: Path(name).read_text() for name in kept} == kept
    written = {"network.safetensors", "vocabulary.json"}
    assert {path.name for path in Path().iterdir()} == written | {"thesis.tex", ".git", "README.md"}


def test_a_network_takes_the_place_of_another(mine):
    facts = {"Task": "move", "phase 2 success": "99.7% [99.5, 99.8]", "Command": "`make demo`"}
    save_pretrained(make_inverse(SHAPES), mine, facts=facts)
    assert sorted(path.name for path in mine.iterdir()) == ["README.md", "network.safetensors"]
    assert from_pretrained(mine).vocabulary is None
    with pytest.raises(UserError, match="'inverse', not 'policy'"):
        from_pretrained(mine, kind="policy")
    card = (mine / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: ifo-grounding\n")
    for shown in ("names the action", "| Preset | strong |", "3x16x16", *facts.values()):
        assert shown in card


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

    def upload(api, *, folder_path, repo_id, allow_patterns, delete_patterns, commit_message=""):
        files = {path.name: path.read_bytes() for path in Path(folder_path).iterdir()}
        assert set(allow_patterns) >= set(files) and delete_patterns == ["vocabulary.json"]
        sent.update(repo_id=repo_id, commit_message=commit_message, files=files)

    def create(api, repo_id, **options):
        sent["created"] = options
        return SimpleNamespace(repo_id=repo_id)

    monkeypatch.setattr("huggingface_hub.HfApi.create_repo", create)
    monkeypatch.setattr("huggingface_hub.HfApi.upload_folder", upload)
    policy, to = make_policy(SHAPES, seed=0), {"vocabulary": VOCABULARY, "hub_id": "a/policy"}
    save_pretrained(policy, tmp_path, **to, private=True, commit_message="first")
    assert sent["files"] == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert sent["repo_id"] == "a/policy" and sent["commit_message"] == "first"
    assert sent["created"] == {"private": True, "exist_ok": True}
    with pytest.raises(TypeError, match="privat"):
        save_pretrained(policy, tmp_path, **to, privat=True)
