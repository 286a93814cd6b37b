"""Typed options: what is refused and how it is said, what a run goes on with, what help tells."""

import dataclasses

import pytest

from ifo_grounding.cli import recipes_folder
from ifo_grounding.config import FREE, Options
from ifo_grounding.data import record_demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.options import field_docs, options_of, options_of_jobs, plain
from ifo_grounding.training import Run


def sections():
    """Every dataclass of options, by its name in the tree."""
    found = {"": Options}
    for field in dataclasses.fields(Options):
        if dataclasses.is_dataclass(field.default_factory):
            found[field.name] = field.default_factory
    return found


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("tsk=move", r"unknown option 'tsk' \(did you mean 'task'\?\): there are "),
        (
            "imitate.stps=1",
            r"unknown option 'imitate.stps' \(did you mean 'imitate.steps'\?\): 'imitate'",
        ),
        ("seed=many", "option seed: value 'many' .* could not be converted to Integer"),
        ("seed=null", "option seed: field 'seed' is not Optional"),
        ("imitate.steps=1.5", "option imitate.steps: value '1.5'"),
        ("imitate=3", "option imitate: "),
        ("world.nope=1", "unknown option 'world.nope'"),
        ("world.factory=a.b", r"unknown option 'world\.factory' \(it is one of world=gymnasium\)"),
        ("preset=huge", "unknown preset 'huge': choose one of paper, strong"),
        ("world=moon", "unknown world 'moon': choose one of babyai, grid, gymnasium, own"),
        ("preset=null", "name=value"),
        ("seed=[a", "name=value"),
        ("=3", "name=value"),
        ("task=a,b", "several values need --multirun"),
        ("+imitate.stepz=1", r"imitate.stepz cannot be added .*did you mean 'imitate.steps'"),
        ("~imitate", "option imitate.batch_size cannot be added or removed"),
        ("~seed", "option seed cannot be added or removed"),
        ("networks.features=5000", "networks: features must be at most 4096"),
        ("run=/", "run needs a name"),
        ("networks.features=2147483647", "networks: features must be at most"),
        ("networks.sentence_pooling=first", "networks: unknown sentence_pooling 'first'"),
        ("instruction.swap_words=???", r"instruction\.swap_words has no value: give"),
        ("controls.lr=nan", "controls: lr"),
        ("evaluate.max_steps=0", "evaluate: max_steps must be at least 1"),
        ("task='${nonexistent}'", "nonexistent"),
        ("imitate.steps=99999999999999999999", "imitate.steps must be at most"),
        ("imitate.lr=-1", "imitate: lr must be above 0"),
        ("instruction.threshold=1.5", "instruction: threshold must be at most"),
        ("self_examine.algorithm=sac", "self_examine: unknown algorithm 'sac'"),
        ("self_examine.pairs=2.5", "option self_examine.pairs"),
        ("evaluate.mode=foo", "evaluate: unknown mode 'foo'"),
        ("transitions.stop_probability=2", "transitions: stop_probability must be at most"),
        ("demonstrations.n=0", "demonstrations: n must be at least 1"),
        ("until=imitat", "unknown until 'imitat'"),
        ("logger=wandbb", "unknown logger"),
        ("threads=100000", "threads must be at most 1024"),
        ("threads=several", "option threads: value .several. .* could not be converted to Integer"),
        ("hydra/launcher=foo", "unknown hydra/launcher 'foo'"),
        ("checkpoint_seconds=nan", "checkpoint_seconds"),
        ("device=gpu", "device=gpu is none: use cpu, cuda or cuda:0"),
        ("variant=../../x", "variant"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(wrong, said):
    with pytest.raises(UserError, match=said) as refused:
        options_of("budget=tiny", wrong)
    assert "\n" not in str(refused.value)


NAMES = ["ü", "a#b", "a=b", "a[1]", "{a:1}", "2024_11_27", "1e-3", "1_000", "true", "null"]


@pytest.mark.parametrize("name", [*NAMES, "it's", "a\\", "(x)", "$x", "a b", "'"])
def test_a_name_is_a_text(name):
    assert options_of(f"run={name}").run == name


@pytest.mark.parametrize("name", ["{a:1}", "it's", "a b"])
def test_names_of_several_runs_are_texts(name):
    several = options_of_jobs(recipes_folder() / "imitate.py", ["-m", f"run={name},b"])
    assert [each.run for each in several] == [name, "b"]


def test_a_name_may_be_quoted_refer_to_others_or_be_none(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    assert options_of("run='q r'").run == "q r"
    assert options_of("seed=3", "run=mine-${seed}").run == "mine-3"
    assert options_of("base=null").base is None
    assert options_of("to=~/shared").to == "/home/me/shared"


@pytest.mark.parametrize("preset", ["strong", "paper"])
@pytest.mark.parametrize(
    ("budget", "world"),
    [("tiny", "grid"), ("many", "babyai"), ("few", "gymnasium"), ("full", "grid")],
)
def test_presets_budgets_and_worlds_fit_together(preset, budget, world):
    options = options_of(f"preset={preset}", f"budget={budget}", f"world={world}")
    assert (options.preset, options.budget) == (preset, budget)
    assert options.self_examine.value_warmup < options.self_examine.iterations
    schedule = "constant" if preset == "paper" else "cosine"
    assert {getattr(options, s).schedule for s in ("inverse", "imitate", "goal")} == {schedule}


def test_few_demonstrations_take_a_budget_of_their_own_unless_one_is_named(tmp_path):
    def imitate(*said):
        options = options_of(*said)
        return options.budget, options.demonstrations.n, options.imitate.batch_size

    assert imitate()[:2] == imitate("task=move")[:2] == ("demo", 40)
    assert imitate("task=pick")[:2] == ("few", 200)
    assert imitate("world=babyai")[:2] == imitate("preset=paper")[:2] == ("many", 3000)
    assert imitate("demonstrations.n=999") == ("few", 999, 64)
    assert imitate("demonstrations.n=1000") == ("many", 1000, 256)
    assert imitate("demonstrations.n=999", "budget=many") == ("many", 999, 256)
    assert imitate("demonstrations.n=999", "preset=paper") == ("many", 999, 128)
    record_demonstrations("move", 250, seed=0).save(tmp_path / "more")  # than few would record
    assert imitate(f"recorded={tmp_path / 'more'}") == ("few", 250, 64)


def test_a_run_goes_on_with_its_own_options(tmp_path):
    run = f"run={tmp_path / 'run'}"
    paper = ("preset=paper", "demonstrations.n=100", "seed=3")
    made = options_of(*paper, "evaluate.states=30", "until=label", run)
    Run(made.run).begin(plain(made), FREE)
    again = options_of(run, "evaluate.episodes=70", "threads=2")
    assert (again.preset, again.demonstrations.n, again.seed) == ("paper", 100, 3)
    assert (again.evaluate.episodes, again.evaluate.states, again.threads) == (70, 30, 2)
    assert again.until is None
    assert again.imitate == made.imitate
    for named in ("preset=strong", "imitate.lr=0.5"):
        other = options_of(run, named)
        with pytest.raises(UserError, match=rf"made with {named.partition('=')[0]}=.*another run="):
            Run(other.run).begin(plain(other), FREE)


def test_a_new_run_has_the_options_of_its_base(tmp_path):
    base, run = f"base={tmp_path / 'base'}", f"run={tmp_path / 'new'}"
    made = options_of("task=pick", "demonstrations.n=50", "seed=3", f"run={tmp_path / 'base'}")
    Run(made.run).begin(plain(made), FREE)
    new = options_of(base, run, "self_examine.lr=0.001")
    assert (new.task, new.budget, new.seed, new.demonstrations.n) == ("pick", "few", 3, 50)
    assert (new.imitate, new.goal) == (made.imitate, made.goal)
    assert (new.self_examine.lr, new.self_examine.steps) == (1e-3, made.self_examine.steps)
    assert (new.run, new.base) == (str(tmp_path / "new"), str(tmp_path / "base"))
    assert options_of(base, run, "seed=4").seed == 4  # which is refused as the run is opened
    with pytest.raises(UserError, match="needs run=, the name of the new run"):
        options_of(base)


def test_a_folder_of_recordings_is_the_same_with_a_slash_at_its_end(tmp_path):
    record_demonstrations("move", 10, seed=0).save(tmp_path / "shown")
    given = [options_of(f"recorded={tmp_path / 'shown'}{end}").recorded for end in ("", "/")]
    assert given == 2 * [str(tmp_path / "shown")]


def test_a_run_of_another_version_says_so(tmp_path):
    values = plain(options_of(f"run={tmp_path / 'run'}"))
    values["imitate"]["momentum"] = 0.9
    Run(tmp_path / "run").begin(values, FREE)
    with pytest.raises(UserError, match=r"imitate\.momentum, which this version does not"):
        options_of(f"run={tmp_path / 'run'}")


def test_every_option_says_what_it_means():
    for name, kind in sections().items():
        docs = field_docs(kind)
        for field in dataclasses.fields(kind):
            if name or field.name not in sections():
                assert docs.get(field.name), f"{name}.{field.name}"
    assert field_docs(Options)["seed"] == "Of all randomness."


def test_every_option_is_read():
    """Recipes and library name each option somewhere, or nothing would come of it."""
    package = recipes_folder().parent / "src" / "ifo_grounding"
    files = [*recipes_folder().glob("*.py"), *package.rglob("*.py")]
    text = "\n".join(file.read_text() for file in files if file.name != "config.py")
    for name, kind in sections().items():
        for field in dataclasses.fields(kind):
            assert field.name in text, f"{name}.{field.name}"


def test_tiny_records_and_plays_little_on_every_level():
    tiny = options_of("world=babyai", "task=BossLevel", "budget=tiny")
    assert tiny.demonstrations.n <= 16  # its bot takes half a minute for these
    assert tiny.evaluate.max_steps * tiny.evaluate.episodes <= 1000


@pytest.mark.parametrize("threads", [2.5, True, None, "auto"])
def test_threads_are_a_whole_number_in_python_too(threads):
    with pytest.raises(UserError, match="threads must be a whole number"):
        dataclasses.replace(options_of("budget=tiny"), threads=threads)
