"""Pieces of the paper's tables: which calls they are, and that each is made once."""

import shutil

import pytest

from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json
from ifo_grounding.options import options_of, options_of_jobs

TINY = (
    *("all.budget=tiny", "+all.networks.features=16", "+all.transitions.n=500"),
    *("all.evaluate.episodes=20", "+all.evaluate.audit_episodes=10", "progress=false"),
    *("+all.imitate.trials=1", "+all.instruction.trials=1", "+all.self_examine.num_envs=8"),
    *("+all.self_examine.select_episodes=8", "+all.self_examine.steps=10"),
    *("+all.self_examine.max_steps=8", "+all.evaluate.max_steps=8"),
    *("preset.strong.inverse.steps=20", "preset.strong.imitate.steps=20"),
    *("preset.strong.instruction.steps=5", "preset.strong.goal.steps=5"),
    *("preset.strong.self_examine.iterations=1", "phase.phase-1.evaluate.states=20"),
    *("phase.pairs-5000.self_examine.pairs=20", "demonstrations=[60]", "tasks=[move]"),
    "presets=[strong]",
)


@pytest.fixture
def reproduce_options(recipes, tmp_path, monkeypatch):
    import reproduce  # noqa: F401  (registers its options)

    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path))

    def composed(*overrides):
        given = [f"results={tmp_path / 'results'}", *overrides]
        return options_of_jobs(recipes / "reproduce.py", given)[0]

    return composed


def test_pieces_are_made_once_and_stand_on_the_same_phase_1(
    reproduce_options, tmp_path, capsys, monkeypatch
):
    from reproduce import Piece, pieces, reproduce, to_make
    from two_phase import two_phase

    def make_here(piece):
        two_phase(options_of(*piece.call.options))

    monkeypatch.setattr(Piece, "make", make_here)  # not in a process of its own

    asked = reproduce_options("figure=6", *TINY)
    ((first, second),) = pieces(asked)
    assert to_make([first, second]) == [first, second]
    assert reproduce(asked) == []
    before, after = read_json(first.file)["results"], read_json(second.file)["results"]
    assert before["phase1"] == after["phase1"]
    assert before["suitability"]["served"]["count"] == 20 and "suitability" not in after
    assert sum(after["endings"]["phase2"]["counts"].values()) == 20
    assert reproduce(reproduce_options("figure=6", "list=true", *TINY)) == []
    assert capsys.readouterr().out.splitlines()[-1] == f"done    {second.file}"
    assert to_make([first, second]) == []
    # Where results came along and runs did not, what builds on phase 1 needs it again.
    for piece in (first, second):
        shutil.rmtree(tmp_path / "runs" / piece.call.run)
    assert to_make([first, second]) == []
    second.file.unlink()
    assert to_make([first, second]) == [first, second]


@pytest.mark.parametrize("asked", ["table=2", "table=3", "table=4", "figure=5", "levels=[GoToObj]"])
def test_every_piece_is_a_call_that_demo_takes(reproduce_options, asked):
    from reproduce import pieces

    chains = pieces(reproduce_options(asked))
    assert len(chains) == (2 if "levels" in asked else 10)
    for piece in (chains[0][-1], chains[-1][-1]):
        options = options_of(*piece.call.options)
        assert options.run == piece.call.run
        assert options.demonstrations.n == 80_000 or "levels" in asked
        assert (options.base is None) == (piece.base is None)
        assert "levels" not in asked or options.world["level"] == "GoToObj"


@pytest.mark.parametrize(
    ("said", "refused"),
    [
        ([], "name a table=1, 2, 3 or 4"),
        (["table=7"], "unknown table 7"),
        (["table=2", "tasks=[fly]"], "unknown task 'fly'"),
        (["table=2", "presets=[film]"], "unknown preset 'film'"),
        (["table=2", "jobs=0"], "jobs must be at least 1"),
    ],
)
def test_what_there_is_not_cannot_be_reproduced(reproduce_options, said, refused):
    from reproduce import pieces

    with pytest.raises(UserError, match=refused):
        pieces(reproduce_options(*said))


def test_a_piece_that_fails_is_named_and_leaves_the_rest_of_its_chain(reproduce_options):
    from reproduce import reproduce

    failed = reproduce(reproduce_options("figure=6", *TINY, "+all.imitate.lr=-1.0"))
    assert len(failed) == 1
    assert "imitate: lr must be above 0" in failed[0].call.log.read_text()


def test_table_1_is_a_piece_for_each_method_of_one_run(reproduce_options, tmp_path):
    from reproduce import pieces

    from ifo_grounding.baselines.config import METHODS

    asked = reproduce_options("table=1", "tasks=[move,pick]", "seeds=[3]")
    chains = pieces(asked)
    assert len(chains) == 2 * 3  # tasks, numbers of demonstrations
    assert {piece.call.recipe for chain in chains for piece in chain} == {"baselines"}
    for chain, budget in ((chains[0], "few"), (chains[-1], "many")):
        named = [
            word for piece in chain for word in piece.call.options if word.startswith("method=")
        ]
        left_out = "" if "task=move" in chain[0].call.options else "lc-rl"  # which cannot plan pick
        assert named == [f"method={method}" for method in METHODS if method != left_out]
        first, last = (options_of(*piece.call.options) for piece in (chain[0], chain[-1]))
        assert first.run == last.run and first.seed == 3
        assert (first.budget, first.evaluate.episodes) == (budget, 5000)
    assert chains[0][0].file == tmp_path / "results/baselines/move-200-strong-bc-seed3.json"
    (of_paper, *_) = pieces(reproduce_options("table=1", "tasks=[move]", "presets=[paper]"))
    as_tables = options_of(*of_paper[0].call.options)
    assert (as_tables.world["tile_size"], as_tables.imitate.steps) == (16, 48_000)
    assert (as_tables.budget, as_tables.demonstrations.n) == ("full", 200)


def test_table_1_of_some_methods_with_more_frames_has_files_of_its_own(reproduce_options, tmp_path):
    from reproduce import pieces

    asked = ("table=1", "tasks=[pick]", "demonstrations=[200]")
    ((gail, agile),) = pieces(
        reproduce_options(*asked, "methods=[agile,ours,bc,gail]", "frames=2000000", "seeds=[1]")
    )
    assert gail.file == tmp_path / "results/baselines/pick-200-strong-2M-gail-seed1.json"
    assert gail.call.run == agile.call.run == "baselines-pick-200-strong-2M-seed1"
    options = options_of(*gail.call.options)
    assert (options.baseline.frames, options.method) == (2_000_000, "gail")
    assert options.variant == "2M"
    with pytest.raises(UserError, match="unknown method 'gial'"):
        reproduce_options(*asked, "methods=[gial]")
    with pytest.raises(UserError, match="frames=700000 is of adversarial methods"):
        pieces(reproduce_options(*asked, "methods=[bco]", "frames=700000"))


def test_every_method_of_table_1_is_tuned_by_as_many_trials(reproduce_options):
    from reproduce import pieces

    from ifo_grounding.baselines.config import METHODS

    asked = reproduce_options("table=1", "tune=true", "tasks=[move]", "demonstrations=[200]")
    (of_strong,) = pieces(asked)
    trials: dict[str, list] = {method: [] for method in METHODS}
    for piece in of_strong:
        given = dict(word.split("=", 1) for word in piece.call.options)
        trials[given["method"]].append(given)
    alike = ("random", "expert", "gail+bc", "agile-chosen")
    counts = {method: len(each) for method, each in trials.items()}
    assert counts == dict.fromkeys(METHODS, 3) | dict.fromkeys(alike, 0)
    assert (
        len({each.call.run for each in of_strong}) == len({each.file for each in of_strong}) == 24
    )
    assert all("evaluate.stream=validation" in piece.call.options for piece in of_strong)
    assert [float(t["baseline.lr"]) for t in trials["gail"]] == [1e-3, 3e-3, 1e-2]
    first: dict[tuple, str] = {}  # by the options whose values a trial chooses
    for piece in of_strong:
        method = dict(word.split("=", 1) for word in piece.call.options)["method"]
        space, own = tuple(asked.tuning[method]), method in ("bc", "bco")  # which are of phase 1
        assert piece.base == (None if own else first.get(space))
        first.setdefault(space, piece.call.run)
    assert len(first) == 5
    taken: set[str] = set()  # every value of every method
    for piece in of_strong:
        words = {word for word in piece.call.options if not word.startswith(("run=", "variant="))}
        if not words <= taken:
            options = options_of(*piece.call.options)
            assert (options.run, options.evaluate.stream) == (piece.call.run, "validation")
        taken |= words
