import shutil

import pytest
from hydra import compose, initialize_config_dir

from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json, write_json

TINY = {
    "all.budget": "tiny",
    "all.evaluate.episodes": 50,
    "preset.strong.inverse.steps": 20,
    "preset.strong.imitate.steps": 20,
    "preset.strong.instruction.steps": 10,
    "preset.strong.goal.steps": 10,
    "preset.strong.self_examine.iterations": 1,
    "phase.phase-1.evaluate.states": 50,
    "phase.pairs-5000.self_examine.pairs": 20,
}


@pytest.fixture
def options(recipes, tmp_path, monkeypatch):
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path))

    def composed(*overrides):
        tiny = [f"options_of.{name}={value}" for name, value in TINY.items()]
        given = ["demonstrations=300", f"results={tmp_path / 'results'}", "progress=false"]
        with initialize_config_dir(version_base=None, config_dir=str(recipes / "conf")):
            return compose("reproduce", [*given, *tiny, *overrides])

    return composed


def test_pieces_are_made_once_and_stand_on_the_same_phase_1(options, capsys):
    from reproduce import pieces, reproduce, to_make

    asked = options("figure=6", "tasks=[move]", "presets=[strong]")
    ((first, second),) = pieces(asked)
    assert not first.done
    assert reproduce(asked) == []
    assert first.done and second.done
    before, after = read_json(first.file)["results"], read_json(second.file)["results"]
    assert before["phase1"] == after["phase1"]
    assert before["suitability"]["served"]["count"] == 50 and "suitability" not in after
    assert sum(after["endings"]["phase2"]["counts"].values()) == 50
    assert {"gained", "lost", "other path", "same path"} == set(after["changes"])

    assert second.changed() == []
    stored = read_json(second.file)
    stored["options"]["instruction"]["candidates"] += 1
    del stored["options"]["instruction"]["fresh_states"], stored["options"]["imitate"]["prior"]
    write_json(second.file, stored)
    assert reproduce(options("figure=6", "tasks=[move]", "presets=[strong]", "list=true")) == []
    *_, listed, noted = capsys.readouterr().out.splitlines()
    assert listed == f"done    {second.file}"
    assert [each.split()[-3:] for each in noted.strip().split(", ")] == [
        ["imitate.prior", "(now", "1000)"],
        ["instruction.candidates=17", "(now", "16)"],
        ["instruction.fresh_states", "(now", "4096)"],
    ]

    written = second.file.stat().st_mtime_ns
    assert reproduce(asked) == []
    assert second.file.stat().st_mtime_ns == written
    # Where results came along and runs did not, what builds on phase 1 needs it again.
    shutil.rmtree(first.folder)
    assert reproduce(asked) == [] and not first.folder.exists()
    shutil.rmtree(second.folder)
    second.file.unlink()
    assert reproduce(asked) == []
    assert first.folder.exists() and read_json(second.file)["results"]["phase1"] == after["phase1"]
    # A call that says what presets and budgets said is the same one.
    said = options(
        "figure=6", "tasks=[move]", "presets=[strong]", "+options_of.all.inverse.batch_size=512"
    )
    ((told, _),) = pieces(said)
    assert told.arguments != first.arguments and told.today["inverse"]["batch_size"] == 512
    assert told.done
    # So is one that names the folder in another way.
    elsewhere = options("figure=6", "tasks=[move]", "presets=[strong]")
    elsewhere.results = f"{elsewhere.results}/../results"
    assert all(piece.done for (chain,) in [pieces(elsewhere)] for piece in chain)
    # A phase 1 that was interrupted while it was made again is what others wait for.
    for piece in (first, second):
        shutil.rmtree(piece.folder)
    second.file.rename(second.file.with_suffix(".kept"))
    (first.folder / "stages").mkdir(parents=True)
    assert [piece.run for piece in to_make([first, second])] == [first.run, second.run]
    second.file.with_suffix(".kept").rename(second.file)
    # Other options, another piece; elsewhere, the same.
    for said, done in (("preset.strong.goal.steps=11", False), ("all.threads=2", True)):
        ((_, changed),) = pieces(
            options("figure=6", "tasks=[move]", "presets=[strong]", f"options_of.{said}")
        )
        assert changed.file == second.file and changed.done == done
    ((_, elsewhere),) = pieces(
        options("figure=6", "tasks=[move]", "presets=[strong]", "device=cuda")
    )
    assert elsewhere.done and elsewhere.arguments[-1] == "device=cuda"
    # What was begun with another phase 1 begins anew, and does not imitate by itself.
    longer = "+options_of.preset.strong.imitate.batch_size=32"
    anew = options("figure=6", "tasks=[move]", "presets=[strong]", longer)
    assert reproduce(anew) == []
    assert "imitate: running" in first.log.read_text()
    assert "imitate: done before" in second.log.read_text()
    assert "self_examine: running" in second.log.read_text()


def test_a_preset_may_have_options_of_one_task_alone(options):
    from reproduce import pieces

    for task, expected in {
        "move": ["networks.sentence_rate=0.03"],
        "pick-out": ["networks.sentence_rate=0.03", "networks.sentence_pooling=last"],
        "pick-udlr": ["networks.sentence_rate=0.1"],
    }.items():
        (chain,) = pieces(options("figure=6", f"tasks=[{task}]", "presets=[paper]"))
        for piece in chain:
            assert [given for given in piece.arguments if "networks" in given] == expected


def test_an_ablation_changes_one_thing_of_the_whole(options, tmp_path):
    from reproduce import pieces, reproduce

    tiny = [
        "options_of.ablation.all.budget=tiny",
        "+options_of.ablation.all.evaluate.episodes=50",
        "options_of.ablation.task.move.demonstrations.n=60",
    ]
    asked = options("ablation=any-instruction", f"ablations={tmp_path / 'found'}", *tiny)
    ((whole, changed), (_, other)) = pieces(asked)
    assert other.run == "ablations-pick-out-any-instruction-seed0"
    assert whole.file.name == "move-60-strong-whole-seed0.json"
    assert set(changed.arguments) - set(whole.arguments) == {
        "run=ablations-move-any-instruction-seed0",
        "variant=any-instruction",
        "base=ablations-move-whole-seed0",
        "instruction.threshold=0.0",
    }
    asked.tasks = ["move"]
    assert reproduce(asked) == []
    before, after = read_json(whole.file)["results"], read_json(changed.file)["results"]
    assert before["phase1"] == after["phase1"]
    assert "true_actions" in before and "true_actions" not in after
    assert after["suitability"]["served"]["rate"] == 1.0


def test_committed_results_are_done(recipes, monkeypatch):
    from reproduce import pieces

    asked = ["table=2", "presets=[strong,film]", "ablation=all", "level=all", "seeds=[0,1,2]"]
    with initialize_config_dir(version_base=None, config_dir=str(recipes / "conf")):
        chains = pieces(compose("reproduce", asked))
    monkeypatch.chdir(recipes.parent)
    found = [piece for chain in chains for piece in chain if piece.file.exists()]
    assert len(found) > 50
    assert [piece.file for piece in found if not piece.done] == []


def test_levels_of_babyai_are_pieces_by_number_of_demonstrations(options, tmp_path):
    from reproduce import pieces, reproduce

    asked = options("level=all", "seeds=[0,1,2]")
    found = [piece for (piece,) in pieces(asked)]
    assert len({piece.file for piece in found}) == 3 * 2 * 3
    assert found[1].file.as_posix() == "results/babyai/GoToLocal-1000-strong-seed0.json"

    asked = options("level=GoToObj", f"levels={tmp_path / 'found'}")
    asked.options_of.level.demonstrations = [40]
    asked.options_of.level.all = {
        "preset": "film",
        "budget": "tiny",
        "phase2": False,
        "references": True,
        "processes": 1,
        "evaluate": {"episodes": 10, "states": 0},
        "progress": False,
    }
    assert reproduce(asked) == []
    ((piece,),) = pieces(asked)
    assert piece.done and piece.file == tmp_path / "found" / "GoToObj-40-film-seed0.json"
    assert {"phase1", "true_actions", "demonstrator"} <= set(read_json(piece.file)["results"])


def test_a_piece_that_fails_ends_its_chain(options):
    from reproduce import reproduce

    asked = options(
        "table=3",
        "tasks=[pick, move]",
        "presets=[strong]",
        "jobs=1",
        "seeds=[1]",
        "+options_of.preset_of_task.strong={pick: {imitate: {trials: 0}}}",
    )
    (failed,) = reproduce(asked)
    assert "imitate.trials must be at least 1" in failed.log.read_text()
    assert failed.run == "tables-pick-strong-phase-1-seed1"


def test_listing_runs_nothing(options, capsys):
    from reproduce import reproduce

    assert reproduce(options("table=2", "list=true", "seeds=[0,1]")) == []
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5 * 2 * (3 + 3 + 4)
    paid = [line.split("/")[-1] for line in lines if "goal-pairs-5000" in line]
    assert len(paid) == 10 and all("-paper-" in name for name in paid)
    assert all(line.startswith("not run") for line in lines)


def test_phases_are_made_with_what_they_begin_with(options):
    from reproduce import pieces

    def runs(*given):
        (chain,) = pieces(options("tasks=[move]", "presets=[strong]", *given))
        return [piece.run.removeprefix("tables-move-strong-") for piece in chain]

    assert runs("table=2", "phases=[pairs-10000]") == ["phase-1-seed0", "pairs-10000-seed0"]
    assert runs("table=4", "phases=[zero-shot]") == ["zero-shot-seed0"]
    both = "phases=[zero-shot-unseen,zero-shot-pairs-5000]"
    assert runs("table=4", both) == [
        "zero-shot-seed0",
        "zero-shot-pairs-5000-seed0",
        "zero-shot-unseen-seed0",
    ]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ([], "name a table"),
        (["table=7"], "table"),
        (["table=2", "tasks=[mvoe]"], "mvoe"),
        (["table=2", "jobs=0"], "jobs must be at least 1"),
        (["table=2", "presets=[huge]"], "huge"),
        (["table=4", "phases=[phase-1]"], "phase-1"),
        (["ablation=all", "phases=[phase-1]"], "phases are of a table"),
        (["ablation=gravity"], "gravity"),
        (["ablation=all", "tasks=[pick]"], "move, pick-out alone"),
        (["level=GoToMoon"], "no level 'BabyAI-GoToMoon-v0'"),
    ],
)
def test_what_cannot_be_reproduced_is_refused(options, given, said):
    from reproduce import pieces

    with pytest.raises(UserError, match=said):
        pieces(options(*given))
