"""The documentation does what it says: its Python runs, its commands and options exist."""

import importlib
import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from ifo_grounding import networks, objectives
from ifo_grounding.cli import recipe_names, recipes_folder, resolve
from ifo_grounding.config import Options
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.options import MULTIRUN, field_docs, options_of, options_of_jobs
from ifo_grounding.tasks import grammar
from ifo_grounding.training import SelfExaminationConfig, self_examine
from ifo_grounding.training.self_examination import ALGORITHMS
from ifo_grounding.transforms import InstructionSampler, LearnedReward
from importing import recipes_importable
from objectives.conftest import LOSSES, make_loss

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS]
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TITLED = re.compile(r'^```python title="([\w.]+)"\n(.*?)^```$', re.MULTILINE | re.DOTALL)
LONGEST = 250
MOST_WORDS = 25_000
SLOW = ("budget=", "threads=", "instruction.", "imitate.", "self_examine.", "evaluate.")
NOT_EXECUTED = "<!-- not executed -->\n"


def blocks(page: Path, *languages: str) -> list[tuple[int, str]]:
    """Line number and code of each fenced block of some languages, in order."""
    text = page.read_text()
    return [
        (text[: found.start(2)].count("\n") + 1, found[2])
        for found in FENCE.finditer(text)
        if found[1] in languages and not text[: found.start()].endswith(NOT_EXECUTED)
    ]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=name_of)
def test_python_of_a_page_runs(page, tmp_path, monkeypatch):
    """All blocks of a page run one after the other, in a folder of their own, as a reader would."""
    if page.name == "own-frames.md":
        pytest.importorskip("minari", reason="the extra minari needs Python 3.11")
    save_files(monkeypatch, tmp_path, page, ROOT / "docs" / "index.md")
    torch.manual_seed(0)
    namespace: dict[str, object] = {"__name__": "__main__"}
    for line, code in blocks(page, "python"):
        # To run through is enough.
        code = re.sub(r"\b(steps|episodes|states)=\d\d+", r"\g<1>=8", code)
        # Leading newlines make a traceback point at the line of the page.
        exec(compile("\n" * (line - 1) + code, str(page), "exec"), namespace)


def save_files(monkeypatch, folder: Path, *pages: Path) -> None:
    """Go to a folder that has the files which pages ask their readers to save."""
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    for name, code in TITLED.findall("\n".join(page.read_text() for page in pages)):
        (folder / name).write_text(code)
        monkeypatch.delitem(sys.modules, Path(name).stem, raising=False)


def test_start_ends_with_a_policy_of_the_readers_own_world(tmp_path, monkeypatch, capsys):
    """Its files and commands as they stand there, with a budget of seconds."""
    start = ROOT / "docs" / "index.md"
    save_files(monkeypatch, tmp_path, start)
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path / "home"))
    asked = [words for page, words in commands("python", "ifo-grounding") if page == name_of(start)]
    assert asked[0] == ["python", "dial.py"]
    runpy.run_path("dial.py", run_name="__main__")
    given = [word for word in asked[1][2:] if not word.startswith(SLOW)]
    assert asked[1][:2] == ["ifo-grounding", "demo"]
    assert {"world.factory=dial.Dial", "recorded=shown", "run=dial"} <= set(given)
    with recipes_importable():
        from two_phase import two_phase

        two_phase(options_of(*given, "budget=tiny", "progress=false"))
    runpy.run_path("ask.py")
    assert "tensor(" in capsys.readouterr().out


def commands(*starts: str) -> list[tuple[str, list[str]]]:
    """Every shell command of the pages from one of the given words on, also behind `srun`."""
    found = []
    for page in PAGES:
        for _, code in blocks(page, "bash", "sh"):
            code = code.replace("\\\n", " ").replace("-m ifo_grounding", "ifo-grounding")
            for line in code.splitlines():
                words = shlex.split(line, comments=True)
                at = [words.index(start) for start in starts if start in words]
                if at:
                    found.append((name_of(page), words[min(at) :]))
    return found


def test_every_recipe_command_has_options_that_exist(tmp_path, monkeypatch):
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path))  # no run has begun
    monkeypatch.syspath_prepend(recipes_folder())
    own = {path.stem for path in (recipes_folder() / "conf").glob("*.yaml")} & {*recipe_names()}
    for name in own:  # which have options of their own
        importlib.import_module(name)
    asked = set()
    for page, (_, command, *rest) in commands("ifo-grounding"):
        if command.startswith("-"):
            continue
        recipe, words = resolve(command, rest)
        assert recipe in recipe_names(), page
        # A reader's own folder is not there, nor a GPU.
        missing = ("recorded=", "device=cuda")
        given = (w for w in words if "=" in w and not w.startswith(missing))
        asked.add((recipe if recipe in own else "two_phase", *given, *MULTIRUN))
    assert len(asked) >= 5
    seen = set()
    for recipe, *given in sorted(asked, key=len, reverse=True):
        words = {(recipe, word) for word in given}
        if not words <= seen:  # what longer commands say has been composed
            assert options_of_jobs(recipes_folder() / f"{recipe}.py", given)
        seen |= words


def test_the_page_of_options_says_what_each_is(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import make_options

    text = make_options.described()
    assert "- **`seed`** = `0`: Of all randomness." in text
    assert "- **`imitate.held_out`** = " in text
    assert "| `lr` | `0.002` / `0.0008` |" in text
    for option in field_docs(Options):
        assert f"**`{option}`**" in text or f"\n## {option}\n" in text or option == "world", option


def test_the_documentation_can_be_read_to_the_end():
    assert sum(len(page.read_text().split()) for page in DOCS) <= MOST_WORDS


def test_no_page_is_long():
    long = [name_of(page) for page in PAGES if len(page.read_text().splitlines()) > LONGEST]
    assert not long


def test_every_make_command_is_a_target():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = {words[1] for _, words in commands("make")}
    assert named <= targets
    assert {"demo", "test"} <= named


def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    words = (re.sub(r"[^\w\s-]", "", heading.lower()).split() for heading in headings)
    return {re.sub("-+", "-", "-".join(each)) for each in words}


def test_every_local_link_and_picture_exists():
    missing = []
    for page in PAGES:
        text = FENCE.sub("", page.read_text())
        for path, anchor, source in re.findall(
            r"\]\(([^)\s#]*)(?:#([^)]*))?\)|src=\"([^\"]+)\"", text
        ):
            target = page.parent / (path + source) if path + source else page
            if "://" in path + source:
                continue
            if not target.exists() or (anchor and anchor not in anchors(target)):
                missing.append(f"{name_of(page)}: {path}{source}#{anchor}")
    assert not missing


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text()))
    assert listed == {p.relative_to(ROOT / "docs").as_posix() for p in DOCS}


def test_every_part_has_an_api_page():
    package = ROOT / "src" / "ifo_grounding"
    parts = {path.parent.name for path in package.glob("*/__init__.py")}
    parts |= {path.stem for path in package.glob("[!_]*.py")}
    text = "\n".join(path.read_text() for path in (ROOT / "docs" / "api").glob("*.md"))
    documented = {name.split(".")[1] for name in re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE)}
    assert documented == parts


def documented(*pages: str) -> set[str]:
    """Everything that the pages set as code."""
    text = "".join((ROOT / "docs" / f"{page}.md").read_text() for page in pages)
    return set(re.findall(r"`([^`\n]+)`", text))


def test_every_metric_of_a_loss_is_documented():
    found = [getattr(objectives, name) for name in objectives.__all__]
    losses = {one for one in found if one in objectives.SupervisedLoss.__subclasses__()}
    built = [make_loss(kind, "strong") for kind in LOSSES]
    assert {type(loss) for loss in built} == losses
    keys = {key for loss in built for key in loss.out_keys}
    assert "loss_words" in keys
    assert keys <= documented("phase1", "phase2")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_metric_of_self_examination_is_documented(algorithm):
    base = PickAndPlaceEnv("move", num_envs=4, seed=0, instructed=False)
    classifier = networks.make_instruction_classifier(base, seed=0)
    reward, policy = networks.make_reward_model(base, seed=0), networks.make_policy(base, seed=0)
    pool = grammar("move").tokens
    transforms = Compose(InstructionSampler(classifier, pool, threshold=0.0), LearnedReward(reward))
    config = SelfExaminationConfig(algorithm, iterations=1, steps=4, minibatch=8, value_warmup=0)
    env = TransformedEnv(base, transforms)
    value = networks.make_value(base, seed=0)
    (metrics,) = self_examine(env, policy, value, config, seed=0)
    assert set(metrics) <= documented("phase2")
