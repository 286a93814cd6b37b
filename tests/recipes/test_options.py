"""What is refused before a run begins, and with which options a finished run is looked at."""

import pytest

from ifo_grounding.cli import run_recipe
from ifo_grounding.errors import UserError


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("device=cuda:7", "no GPU|CUDA"),
        ("logger=wandb", r"pip install 'ifo-grounding\[wandb\]'"),
        ("task=mov", "unknown task 'mov'"),
        ("self_examine.algorithm=sac", "unknown algorithm 'sac'"),
        ("instruction.threshold=1.5", "threshold is a probability"),
        ("imitate.batch_size=0", "batch_size"),
        ("world.layout.size=2", "size must be 3..16"),
    ],
)
def test_what_a_later_stage_would_refuse_is_refused_first(
    compose, recipes, tmp_path, monkeypatch, wrong, said
):
    from two_phase import two_phase

    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=said):
        two_phase(compose("two_phase", wrong))
    assert not (tmp_path / "run").exists()


def test_what_a_run_was_made_with_counts_but_for_what_is_named(compose):
    from _options import merged
    from _shared import plain

    made = plain(compose("two_phase", "preset=film", "demonstrations.n=100", "seed=3"))
    given = compose("evaluate", "evaluate.episodes=70", "instruction.choose=random", "threads=2")
    options = merged(given, made, ["run", "evaluate.episodes", "instruction.choose", "threads"])
    assert (options.network, options.demonstrations.n, options.seed) == ("film", 100, 3)
    assert (options.evaluate.episodes, options.instruction.choose) == (70, "random")
    assert options.evaluate.states == given.evaluate.states
    assert (options.threads, options.run) == (2, given.run)
    assert options.imitate == compose("two_phase", "preset=film").imitate
    assert merged(given, made, ["budget"]).evaluate == given.evaluate

    for named in ("preset", "demonstrations.n", "seed"):
        with pytest.raises(UserError, match="was made with"):
            merged(given, made, [named])
    assert merged(given, made, ["task", "world"]).task == "move"
    del made["references"], made["evaluate"]["split"]  # of a run older than these options
    older = merged(given, made, [])
    assert (older.references, older.evaluate.split) == (False, "all")


def test_few_demonstrations_are_imitated_in_small_batches_unless_told(compose):
    def imitate(*said):
        options = compose("two_phase", *said).imitate
        return options.batch_size, options.get("prior", 0)

    assert imitate("demonstrations.n=999") == (64, 1000)
    assert imitate("demonstrations.n=1000") == (256, 2000)
    assert imitate("demonstrations.n=999", "imitate.batch_size=32") == (32, 1000)
    assert imitate("demonstrations.n=999", "preset=paper") == (128, 0)


def test_a_run_may_be_called_by_a_number(compose):
    from _shared import open_run

    assert open_run(compose("two_phase", "run=7")).folder.name == "7"


def test_a_report_says_what_the_run_was_made_with(compose, tmp_path, capsys):
    from two_phase import train_phases

    train_phases(
        compose("two_phase", "preset=film", "demonstrations.n=100", "seed=3", "phase2=false")
    )
    run_recipe("report", [f"run={tmp_path / 'run'}", "evaluate.episodes=20"])
    page = (tmp_path / "run" / "report" / "index.html").read_text()
    assert "preset film" in page
    assert "100 demonstrations, seed 3, 20 evaluation scenes" in page
    with pytest.raises(SystemExit):
        run_recipe("evaluate", [f"run={tmp_path / 'run'}", "task=pick"])
    assert "was made with task=move, not pick" in capsys.readouterr().err


def test_scenes_of_pairs_that_were_named_are_no_zero_shot(compose, capsys):
    from evaluate import evaluate
    from two_phase import train_phases

    train_phases(compose("two_phase", "demonstrations.n=100", "phase2=false"))
    evaluate(compose("evaluate", "evaluate.split=zero-shot", "demonstrations.n=100"))
    assert "no zero-shot success" in capsys.readouterr().err
