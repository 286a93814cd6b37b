import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from ifo_grounding.errors import UserError
from ifo_grounding.files import write_json
from ifo_grounding.networks import (
    Shapes,
    from_pretrained,
    make_inverse,
    make_policy,
    save_pretrained,
)
from ifo_grounding.tasks import VOCABULARY, Vocabulary

SHAPES = Shapes(image_shape=(3, 16, 16), vocabulary_size=len(VOCABULARY))


def test_a_shared_network_comes_back_with_its_words(tmp_path):
    network = make_policy(SHAPES, seed=0)
    folder = network.save_pretrained(tmp_path / "mine", vocabulary=VOCABULARY)
    again = from_pretrained(folder)
    assert type(again) is type(network)
    for name, weight in network.state_dict().items():
        assert torch.equal(weight, again.state_dict()[name])
    assert again.vocabulary == VOCABULARY
    assert not again.training


def test_the_card_says_what_the_network_is(tmp_path):
    facts = {"Task": "move", "phase 2 success": "99.7% [99.5, 99.8]", "Command": "`make demo`"}
    save_pretrained(make_policy(SHAPES), tmp_path / "mine", facts=facts)
    card = (tmp_path / "mine" / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: ifo-grounding\n")
    for shown in ("chooses an action", "| Preset | strong |", "3x16x16", *facts.values()):
        assert shown in card
    assert from_pretrained(tmp_path / "mine").vocabulary is None


def test_words_are_kept_when_a_network_is_saved_again(tmp_path):
    save_pretrained(make_policy(SHAPES), tmp_path / "mine", vocabulary=VOCABULARY)
    save_pretrained(from_pretrained(tmp_path / "mine"), tmp_path / "again")
    assert from_pretrained(tmp_path / "again").vocabulary == VOCABULARY
    fewer = Vocabulary(VOCABULARY.words[:5])
    save_pretrained(from_pretrained(tmp_path / "mine"), tmp_path / "again", vocabulary=fewer)
    assert from_pretrained(tmp_path / "again").vocabulary == fewer


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (Vocabulary([*VOCABULARY.words, "fly"]), "has 49 token ids .* built for 48 and 16"),
        (Vocabulary(VOCABULARY.words, length=9), "and 9 per instruction, .* for 48 and 16"),
    ],
)
def test_words_that_do_not_fit_are_refused(tmp_path, words, said):
    with pytest.raises(UserError, match=f"the vocabulary .*{said}"):
        save_pretrained(make_policy(SHAPES), tmp_path / "mine", vocabulary=words)
    assert not list(tmp_path.iterdir())
    save_pretrained(make_policy(SHAPES), tmp_path / "mine")
    content = {"words": words.words, "length": words.length}
    write_json(tmp_path / "mine" / "vocabulary.json", content)
    with pytest.raises(UserError, match=rf"vocabulary\.json .*{said}"):
        from_pretrained(tmp_path / "mine")


@pytest.mark.parametrize("content", [[1], {}, None, {"words": [1], "length": 16}, {"words": 3}])
def test_damaged_words_are_refused(tmp_path, content):
    save_pretrained(make_policy(SHAPES), tmp_path / "mine", vocabulary=VOCABULARY)
    write_json(tmp_path / "mine" / "vocabulary.json", content)
    with pytest.raises(UserError, match=r"vocabulary\.json holds no words"):
        from_pretrained(tmp_path / "mine")


def test_other_files_of_a_folder_stay(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = {"thesis.tex": "chapter 1", ".git/HEAD": "ref: refs/heads/main", "README.md": "# Mine"}
    for name, text in kept.items():
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)
    assert save_pretrained(make_policy(SHAPES), ".", vocabulary=VOCABULARY) == Path()
    assert {name: Path(name).read_text() for name in kept} == kept
    assert {path.name for path in Path().iterdir()} == {
        "thesis.tex",
        ".git",
        "README.md",
        "network.safetensors",
        "vocabulary.json",
    }
    assert from_pretrained(".").vocabulary == VOCABULARY


def test_a_folder_that_is_none_is_refused(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for name in ("file", "link", "file/below"):
        with pytest.raises(UserError, match=f"{name} is no folder and cannot be made one"):
            save_pretrained(make_policy(SHAPES), tmp_path / name)
    assert (tmp_path / "file").read_text() == "mine"


def test_a_network_takes_the_place_of_another(tmp_path):
    save_pretrained(make_policy(SHAPES), tmp_path / "mine", vocabulary=VOCABULARY)
    save_pretrained(make_inverse(SHAPES), tmp_path / "mine")
    assert sorted(p.name for p in (tmp_path / "mine").iterdir()) == [
        "README.md",
        "network.safetensors",
    ]
    with pytest.raises(UserError, match="'inverse', not 'policy'"):
        from_pretrained(tmp_path / "mine", kind="policy")


def test_what_cannot_be_shared_or_found_is_said(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="only what a make_"):
        save_pretrained(nn.Linear(1, 1), tmp_path / "mine")
    assert not list(tmp_path.iterdir())
    with pytest.raises(UserError, match=r"no folder.*user/name"):
        from_pretrained(tmp_path / "missing")
    with pytest.raises(UserError, match=r"no folder.*user/name"):
        from_pretrained("missing")
    save_pretrained(make_policy(SHAPES), tmp_path / "mine")
    with pytest.raises(UserError, match="is a file: pass the folder"):
        from_pretrained(tmp_path / "mine" / "network.safetensors")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="runs/policy is neither a folder nor a repository"):
        from_pretrained("runs/policy")
    with pytest.raises(UserError, match=r"neither a folder .*HFValidationError"):
        from_pretrained("some--one/policy")
    with pytest.raises(UserError, match=r"a/policy could not be sent .*hf auth login"):
        save_pretrained(make_policy(SHAPES), tmp_path / "mine", hub_id="a/policy")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(UserError, match=r"ifo-grounding\[hub\]"):
        from_pretrained("someone/something")


def test_the_hub_gets_the_folder_in_one_commit(tmp_path, monkeypatch):
    sent = {}

    def upload(api, *, folder_path, repo_id, allow_patterns, delete_patterns, commit_message=""):
        files = {path.name: path.read_bytes() for path in Path(folder_path).iterdir()}
        assert set(allow_patterns) >= set(files) and delete_patterns == ["vocabulary.json"]
        sent.update(repo_id=repo_id, commit_message=commit_message, files=files)
        return "https://a.commit"

    def create(api, repo_id, **options):
        sent["created"] = options
        return SimpleNamespace(repo_id=repo_id)

    monkeypatch.setattr("huggingface_hub.HfApi.create_repo", create)
    monkeypatch.setattr("huggingface_hub.HfApi.upload_folder", upload)
    policy = make_policy(SHAPES, seed=0)
    save_pretrained(
        policy,
        tmp_path,
        vocabulary=VOCABULARY,
        hub_id="a/policy",
        private=True,
        commit_message="first",
    )
    assert sent["files"] == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert sent["repo_id"] == "a/policy" and sent["commit_message"] == "first"
    assert sent["created"] == {"private": True, "exist_ok": True}
    policy.push_to_hub("a/other", facts={"Task": "move"})
    assert sent["repo_id"] == "a/other" and b"| Task | move |" in sent["files"]["README.md"]
    with pytest.raises(TypeError, match="privat"):
        policy.push_to_hub("a/other", privat=True)
