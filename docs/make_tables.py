"""Write the paper's tables with the numbers of here: ``python docs/make_tables.py``.

Reads ``results/tables/*.json``, the pieces of the recipe `reproduce`, and writes the parts of
``docs/tables.md`` and ``docs/zero-shot.md`` between their marks. A test checks that they are up to
date.
"""

import math
from collections.abc import Callable
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

from omegaconf import OmegaConf

from ifo_grounding.evaluation.endings import ENDINGS, SHARED
from ifo_grounding.files import atomic_write
from ifo_grounding.report import markdown_table
from ifo_grounding.report.paper import EPISODES, TABLE_2, TABLE_3, TABLE_4
from ifo_grounding.report.results import (
    brief,
    commands_note,
    read_results,
    restored,
    same_policy,
)
from ifo_grounding.report.results import unpacked as outcomes
from ifo_grounding.report.tables import renewed
from ifo_grounding.stats import Rate, paired_difference, two_level_bootstrap, wilson
from ifo_grounding.tasks import TASKS
from ifo_grounding.tasks.goals import REASONS
from ifo_grounding.tasks.grammar import HOLDOUTS

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "tables.md"
README = ROOT / "README.md"
ZERO_SHOT = ROOT / "docs" / "zero-shot.md"
PARTS = ROOT / "results" / "zero-shot"
RECOMBINED = ROOT / "results" / "recombined"
ABLATIONS = ROOT / "results" / "ablations"
PRESETS = ("paper", "film", "strong")
PHASES = ("phase-1", "pairs-5000", "pairs-10000")
GOAL = "goal-pairs-5000"
"""Phase 2 of preset `paper`, paid for the goal instead of for actions."""
ZERO_SHOT_PHASES = ("zero-shot", "zero-shot-pairs-5000")
ERRORS, FAILURES = REASONS[1:], ENDINGS[1:]
NOT_RUN = "not run"
PAID_FOR_GOALS = "paid for goals"
SHOWN_CHANGES = ("pairs-5000", GOAL)
"""Pieces whose phase 2 Fig. 6 compares with phase 1."""
KEPT = "phase 1 kept"
"""Of phase 2 where no look at what practice had made found it better."""
EARLIER = "†"
EARLIER_NOTE = (
    f"{EARLIER} made with other options than `reproduce` says today; its file names them. What"
    " presets say may have changed since, too: `reproduce` with `list=true` says it of each piece."
)
STRAYED = "‡"
STRAYED_NOTE = (
    f"{STRAYED} with a seed that practised from another phase 1 than the one shown, of other"
    f" options ({EARLIER}) or made on another machine: its gain is over its own."
)
OPTIONS_OF: dict[str, Any] = OmegaConf.to_container(  # type: ignore[assignment]
    OmegaConf.load(ROOT / "recipes" / "conf" / "reproduce.yaml").options_of
)
"""What `reproduce` says to each preset, task and phase today."""

Pieces = dict[Any, list[dict[str, Any]]]


def pieces() -> Pieces:
    """Return the committed seeds of each task, preset and phase."""
    return read_results(
        ROOT / "results" / "tables", lambda o: (o["task"], o["network"], o["variant"])
    )


def success(
    runs: list[dict[str, Any]] | None, name: str, first: list[dict[str, Any]] | None = None
) -> str:
    """Return a policy's success over its seeds and, of phase 2, the paired gain.

    It is marked where practice began with another phase 1 than is shown, that of ``first``.
    """
    if not runs:
        return NOT_RUN
    marks = mark(runs) + (STRAYED if strayed(runs, first or []) else "")
    rate = f"{brief(two_level_bootstrap(outcomes(runs, name)))}{marks}"
    if name == "phase1":
        return rate
    kept = sum(same_policy(run, name) for run in runs)
    if kept == len(runs):
        return f"{rate}<br>{KEPT}"
    gain = paired_difference(outcomes(runs, "phase1"), outcomes(runs, name))
    aside = f"; {KEPT}: {kept} of {len(runs)} seeds" if kept else ""
    return f"{rate}<br>{brief(gain)} points{aside}"


def strayed(runs: list[dict[str, Any]], first: list[dict[str, Any]]) -> bool:
    """Whether any began with another phase 1 than that of the same seed in ``first``."""
    shown = {run["options"]["seed"]: run for run in first}
    return any(
        not same_phase_1(run, shown[run["options"]["seed"]])
        for run in runs
        if run["options"]["seed"] in shown
    )


def same_phase_1(run: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two files are of one phase 1: as successful, or of one imitation.

    Looked at on another machine, where sums are rounded otherwise, one policy may solve a scene
    more or less. How long it imitated goes with a run, and no two runs take as long.
    """
    outcomes = [each["results"]["phase1"]["outcomes"] for each in (run, other)]
    took = [each["stages"]["imitate"] for each in (run, other)]
    return outcomes[0] == outcomes[1] or took[0] == took[1]


def mark(runs: list[dict[str, Any]]) -> str:
    """Return the mark of results that were made with other options than today's, if they were."""
    return EARLIER if any(not is_of_today(run["options"]) for run in runs) else ""


def today(preset: str, task: str) -> dict[str, dict[str, Any]]:
    """Return the options that `reproduce` says to a preset and a task today, by section."""
    of_task = OPTIONS_OF["preset_of_task"].get(preset, {}).get(task, {})
    return OmegaConf.to_container(  # type: ignore[return-value]
        OmegaConf.merge(OPTIONS_OF["preset"][preset], of_task)
    )


def is_of_today(options: dict[str, Any]) -> bool:
    """Whether options of a piece are those that `reproduce` says to its preset and task today."""
    return all(
        options.get(section, {}).get(name) == value
        for section, values in today(options["network"], options["task"]).items()
        for name, value in values.items()
    )


def noted(*parts: str) -> str:
    """Return parts of a page, with what the mark means where it occurs."""
    text = "\n\n".join(part for part in parts if part)
    notes = {EARLIER: EARLIER_NOTE, STRAYED: STRAYED_NOTE}
    return "\n\n".join([text, *(note for sign, note in notes.items() if sign in text)])


def mean(shares: list[float], digits: int = 2) -> str:
    """Return the mean of shares in percent."""
    return f"{100 * sum(shares) / len(shares):.{digits}f}%"


def of_paper(percent: float) -> Rate:
    """Return a rate of the paper with the interval that its number of episodes implies."""
    return wilson(round(percent / 100 * EPISODES), EPISODES)


def gain_of_paper(before: Rate, after: Rate) -> str:
    """Return the difference of two rates of different episodes (Newcombe 1998, his method 10)."""
    gain = after.rate - before.rate
    low = gain - math.hypot(after.rate - after.low, before.high - before.rate)
    high = gain + math.hypot(after.high - after.rate, before.rate - before.low)
    return f"{100 * gain:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}] points"


def named(preset: str, phase: str) -> str:
    """Return what a table calls a preset in a phase."""
    return f"`{preset}`, {PAID_FOR_GOALS}" if phase == GOAL else f"`{preset}`"


def success_rows(
    found: Pieces,
    reported: dict[str, tuple[float, ...]],
    phases: tuple[str, ...],
    heads: list[str],
    also: tuple[str, ...] = (),
) -> list[dict[str, str]]:
    """Return the paper's rates and ours, one row each: of phase 1, then of phase 2.

    A preset that was run on no task has no row. Another way to practise has a row of its own where
    it was run, with its phase 2 in the first column of phase 2.
    """
    rows = []
    ran = {preset for _, preset, phase in found if phase in phases}
    presets = [preset for preset in PRESETS if preset in ran]
    for task in TASKS:
        first, *later = map(of_paper, reported[task])
        told = [f"{brief(rate)}<br>{gain_of_paper(first, rate)}" for rate in later]
        rows.append({"task": f"**{task}**", "by": "the paper", "seeds": ""})
        rows[-1] |= dict(zip(heads, [brief(first), *told], strict=True))
        for preset in presets:
            runs = [found.get((task, preset, phase)) for phase in phases]
            shown = ["phase1", *["phase2"] * (len(phases) - 1)]
            values = [success(some, name, runs[0]) for some, name in zip(runs, shown, strict=True)]
            counts = [len(some) for some in runs if some]
            seeds = " / ".join(map(str, counts if len(set(counts)) > 1 else counts[:1]))
            rows.append({"task": "", "by": named(preset, phases[0]), "seeds": seeds})
            rows[-1] |= dict(zip(heads, values, strict=True))
            for phase in also:
                if some := found.get((task, preset, phase)):
                    row = {"task": "", "by": named(preset, phase), "seeds": str(len(some))}
                    same = len(some) == len(runs[0] or [])
                    before = "as above" if same else success(some, "phase1")
                    rows.append(
                        {**row, heads[0]: before, heads[1]: success(some, "phase2", runs[0])}
                    )
    return rows


def suitability_rows(found: Pieces) -> list[dict[str, str]]:
    """Return the rows of Table 3: the paper's rates and ours."""
    heads = {"rate": "suitable", "served": "served", "servable": "at most"}
    rows = []
    for task in TASKS:
        blank = dict.fromkeys(heads.values(), "")
        told = {**blank, "suitable": f"{TABLE_3[task]:.1f}%"}
        rows.append({"task": f"**{task}**", "by": "the paper", **told})
        for preset in PRESETS:
            runs = found.get((task, preset, "phase-1"), [])
            row = {"task": "", "by": f"`{preset}`"}
            for name, title in heads.items():
                values = [
                    brief(restored(Rate, run["results"]["suitability"][name])) + mark([run])
                    for run in runs
                ]
                row[title] = "<br>".join(values) or NOT_RUN
            rows.append(row)
    return rows


def counted(
    found: Pieces,
    phases: tuple[str, ...],
    names: tuple[str, ...],
    read: Callable[[dict[str, Any]], dict[str, int]],
) -> list[dict[str, str]]:
    """Return rows of counts by name, added over seeds, of what was run."""
    rows = []
    for task, preset, phase in product(TASKS, PRESETS, phases):
        if runs := found.get((task, preset, phase)):
            counts = [read(run["results"]) for run in runs]
            added = {name: f"{sum(some.get(name, 0) for some in counts):,}" for name in names}
            of = {"task": task, "preset": named(preset, phase), "seeds": str(len(runs))}
            rows.append({**of, **added})
    return rows


def change_rows(found: Pieces) -> list[dict[str, str]]:
    """Return the rows of Fig. 6."""
    rows = []
    for part, title in (("gained", "phase 2 alone"), ("lost", "phase 1 alone")):
        some = counted(
            found, SHOWN_CHANGES, FAILURES, lambda results, part=part: results["changes"][part]
        )
        rows += [{"solved by": title, **row} for row in some]
    return sorted(rows, key=lambda row: TASKS.index(row["task"]))


def table(rows: list[dict[str, str]]) -> str:
    return markdown_table(rows) if rows else "Not run yet."


def content() -> str:
    """Return the part of the page that the results decide."""
    found = pieces()
    phases = ["phase 1", "phase 2, 5,000 pairs", "phase 2, 10,000 pairs"]
    path_rows = counted(
        found,
        SHOWN_CHANGES,
        ("other path", "same path"),
        lambda results: {name: results["changes"][name] for name in ("other path", "same path")},
    )
    parts = [
        "## Table 2: success",
        noted(table(success_rows(found, TABLE_2, PHASES, phases, also=(GOAL,)))),
        f"{PAID_FOR_GOALS.capitalize()}: practice with the"
        " [goal judge](phase2.md#the-goal-judge-an-extension), an extension. Imitation that goes on"
        " for as long [gained as much or more](#where-a-number-falls-short) on the two tasks where"
        " it was tried.",
        "## Table 3: suitable instructions",
        "Of the instructions chosen for 20,000 fresh states, the share that is suitable, and the"
        " share of states that got one. `at most` is the share of states that any instruction of"
        " the demonstrations suits, by the oracle, of the first 500 of these states alone.",
        noted(table(suitability_rows(found))),
        "## Table 4: zero-shot",
        "Instructions that mention at least one of three colour-shape pairs which no instruction of"
        " the demonstrations mentions.",
        noted(table(success_rows(found, TABLE_4, ZERO_SHOT_PHASES, phases[:2]))),
        "## Figure 5: what is wrong with unsuitable choices",
        "Of 20,000 states with each seed, added over seeds.",
        table(
            counted(found, ("phase-1",), ERRORS, lambda results: results["suitability"]["errors"])
        ),
        "## Figure 6: what phase 2 changes",
        "Scenes that only one of the two policies solves, by what the other one did there, added"
        " over seeds.",
        table(change_rows(found)),
        "Scenes that both solve, by another path or by the same:",
        table(path_rows),
        commands_note(found.values()),
        "## Ablations",
        "What one choice does where demonstrations are few: 200 of `move` and 500 of `pick-out`,"
        " preset `strong` as it was before it imitated so few in [smaller"
        " batches](phase1.md#few-demonstrations); on `move` its instruction module is an earlier"
        " one, without fresh states, but where batches are of 1,024 or images larger."
        " Gains of phase 2 over"
        " phase 1 and differences from the whole, both greedy, are paired by scene, in points. The"
        " paper's reward is paid for every action, and discounted here as the goal reward is: a"
        " policy then earns most that never stops"
        " ([an example](phase2.md#an-example-of-a-reward-that-is-exploited)). Preset `paper`"
        " credits each action with its own reward alone. Random instructions still teach `move`,"
        " where every third suits by chance, and mislead `pick-out`, where hardly any does."
        " The whole removed no false negatives on either task: where their share is not estimated,"
        " only what passes the threshold changes.",
        ablation_content(),
    ]
    return "\n\n".join(part for part in parts if part)


VARIANTS_OF_PHASES = {
    "whole": "the preset, batches of 256",
    "true-actions": "true actions instead of labels: an upper bound",
    "unchanged-kept": "transitions that change nothing are kept",
    "steps-10000": "10,000 random steps instead of 60,000",
    "steps-2000": "2,000 random steps",
    "batch-64": "imitation in batches of 64 instead of 256",
    "batch-1024": "imitation in batches of 1,024",
    "tiles-16": "images of 96 x 96 pixels instead of 48 x 48",
    "no-removal": "the share of false negatives is not estimated: no removal, no calibration",
    "any-instruction": "random instructions instead of chosen ones",
    "action-reward": "the paper's reward of actions instead of the goal reward",
    "both-rewards": "both rewards",
}
"""What each variant of `recipes/reproduce.py ablation=all` is."""


def ablation_content() -> str:
    """Return a table of what each choice does, for each task."""
    found: Pieces = read_results(ABLATIONS, lambda o: (o["task"], o["variant"]))
    rows = []
    for task in TASKS:
        for name, said in VARIANTS_OF_PHASES.items():
            if runs := found.get((task, "whole" if name == "true-actions" else name)):
                whole = found.get((task, "whole"), [])
                rows.append({"task": task, "": said, **ablation_row(runs, whole, name)})
    return "\n\n".join(part for part in (table(rows), commands_note(found.values())) if part)


def ablation_row(
    runs: list[dict[str, Any]], whole: list[dict[str, Any]], name: str
) -> dict[str, str]:
    """Return what a variant reaches, and how far that is from the whole."""
    bound = name == "true-actions"
    first, last = ("true_actions", "phase1") if bound else ("phase1", "phase2")
    row = {"seeds": str(len(runs)), "labels": "", "phase 1": "", "phase 2": "", "gain": ""}
    row |= {"less the whole": "", "suitable": ""}
    row["phase 1"] = brief(two_level_bootstrap(outcomes(runs, first)))
    if bound:
        gap = paired_difference(outcomes(runs, last), outcomes(runs, first))
        return {**row, "less the whole": f"{brief(gap)} (phase 1)"}
    row["labels"] = mean([run["results"]["labels"]["rate"]["rate"] for run in runs])
    row["phase 2"] = brief(two_level_bootstrap(outcomes(runs, last)))
    row["gain"] = brief(paired_difference(outcomes(runs, first), outcomes(runs, last)))
    if name != "whole" and len(whole) == len(runs):
        gap = paired_difference(outcomes(whole, last), outcomes(runs, last))
        row["less the whole"] = brief(gap)
    row["suitable"] = mean([run["results"]["suitability"]["rate"]["rate"] for run in runs])
    return row


def zero_shot_content() -> str:
    """Return the part of the page on zero-shot that the results decide."""
    found = pieces()
    rates, endings = [], []
    for task in TASKS:
        for preset in PRESETS:
            for phase, piece in (
                ("phase1", "zero-shot"),
                ("phase2", "zero-shot-pairs-5000"),
                ("phase1", "zero-shot-unseen"),
            ):
                if runs := found.get((task, preset, piece)):
                    common = zero_shot_common(runs, phase)
                    rates.append({**common, **zero_shot_rates(runs, phase)})
                    endings.append({**common, **zero_shot_endings(runs, phase)})
    return "\n\n".join(
        [
            table(rates),
            "Trained pairs: the mean over seeds, with the interval of one seed's scenes. Success of"
            " each held-out pair, and where the agent ended instead; of wrong objects,"
            " how many share the colour, the shape or neither with the right one:",
            table(endings),
        ]
    )


def readme_tables() -> str:
    """Return the short form of Tables 2 and 3: the paper, its networks here, and the default."""
    found = pieces()
    rows, suitable = [], []
    for task in TASKS:
        before, *after = TABLE_2[task]
        rows.append({"task": task, "reported, 1 / best 2": f"{before:.1f}% / {max(after):.1f}%"})
        suitable.append({"task": task, "reported": f"{TABLE_3[task]:.1f}%"})
        for preset in ("paper", "strong"):
            first, practised = (
                found.get((task, preset, phase)) for phase in ("phase-1", "pairs-5000")
            )
            rows[-1][f"`{preset}`, 1"] = success(first, "phase1")
            rows[-1][f"`{preset}`, 2"] = success(practised, "phase2", first)
            if preset == "paper":
                paid = found.get((task, preset, GOAL))
                rows[-1][f"2, {PAID_FOR_GOALS}"] = success(paid, "phase2", first)
                seeds = [str(len(some or [])) for some in (first, practised, paid)]
                rows[-1]["seeds"] = " / ".join(seeds)
            chosen = [run["results"]["suitability"]["rate"]["rate"] for run in first or []]
            suitable[-1][f"`{preset}`"] = mean(chosen, 1) + mark(first) if first else NOT_RUN
    return noted(table(rows), "Suitable instructions among those chosen:", table(suitable))


def readme_zero_shot() -> str:
    """Return the short table of zero-shot, beside the paper's."""
    found = pieces()
    rows = []
    for task in TASKS:
        runs = found.get((task, "strong", "zero-shot"))
        before, after = TABLE_4[task]
        rows.append(
            {
                "task": task,
                "seeds": str(len(runs or [])),
                "held-out pairs": success(runs, "phase1"),
                "the paper, phase 1 / 2": f"{before:.1f}% / {after:.1f}%",
            }
        )
    return table(rows)


def zero_shot_common(runs: list[dict[str, Any]], phase: str) -> dict[str, str]:
    """Return what was run: the first cells of both tables."""
    options = runs[0]["options"]
    return {
        "task": options["task"],
        "preset": f"`{options['network']}`",
        "phase": phase[-1],
        "lie about": "yes" if options["world"]["holdout_visible"] else "no",
    }


def zero_shot_rates(runs: list[dict[str, Any]], phase: str) -> dict[str, str]:
    """Return success on held-out and on trained pairs."""
    trained = [run["results"]["trained"][phase]["counts"] for run in runs]
    scenes = sum(trained[0].values())  # the same ones with every seed
    of_trained = wilson(round(fmean(counts["success"] for counts in trained)), scenes)
    reported = TABLE_4[runs[0]["options"]["task"]]
    return {
        "seeds": str(len(runs)),
        "held-out pairs": brief(two_level_bootstrap(outcomes(runs, phase))),
        "trained pairs": brief(of_trained),
        "the paper reports": f"{reported[int(phase[-1]) - 1]:.1f}%",
    }


def zero_shot_endings(runs: list[dict[str, Any]], phase: str) -> dict[str, str]:
    """Return success of each held-out pair, and where the agent went instead."""
    held_out = [run["results"]["endings"][phase] for run in runs]
    row = {}
    for name in HOLDOUTS[runs[0]["options"]["world"]["holdout"]]:
        each = [ends["by_object"][name] for ends in held_out if name in ends["by_object"]]
        row[name] = f"{100 * sum(won for won, _ in each) / sum(of for _, of in each):.1f}%"
    total = sum(sum(ends["counts"].values()) for ends in held_out)
    for name in FAILURES:
        row[name] = f"{100 * sum(ends['counts'][name] for ends in held_out) / total:.1f}%"
    alike = (str(sum(ends["shared"][name] for ends in held_out)) for name in SHARED[1:])
    return {**row, ", ".join(SHARED[1:]): ", ".join(alike)}


VARIANTS = {
    "whole": "the preset",
    "sentence": "preset `film`: the instruction as one vector",
    "sentence-narrow": "the same, 16 features instead of 64",
    "sentence-dropout": "the same, dropout of 0.5",
    "sentence-decay": "the same, weight decay of 1",
    "sentence-early": "the same, stopped after a quarter of the steps",
    "sentence-jitter": "the same, brightness of each colour channel drawn anew at every step",
    "sentence-absent": "the same, objects of held-out pairs never lie about while it learns",
    "whole-absent": "the preset, objects of held-out pairs never lie about while it learns",
    "cells-whole": "words see whole cells, not colour and form",
    "silent-whole": "what hears no words sees colours too",
    "no-charge": "speaking is free",
    "no-swaps": "roles hear the words themselves",
    "no-noise": "the manner hears words without noise",
    "one-way": "maps are read one way",
}
"""What each variant of `recipes/zero_shot.py` is."""
PROBES = {
    "seeing_colour": "sees colour",
    "seeing_shape": "sees shape",
    "reading_colour": "reads colour",
    "reading_shape": "reads shape",
    "matching": "matches",
}
"""What each probe asks, as a column."""


def parts_content() -> str:
    """Return the table of what each part of the preset does, one part left out at a time."""
    found: Pieces = read_results(PARTS, lambda o: o["variant"])
    rows = [
        part_row(f"{said} (`{name}`)", found[name])
        for name, said in VARIANTS.items()
        if name in found
    ]
    return "\n\n".join([table(rows), commands_note(found.values())])


PRACTISED = {"own": "the demonstrations' alone", "recombined": "recombined ones too"}
"""Which instructions phase 2 practises, by variant."""


def recombined_content() -> str:
    """Return the table of what practising recombined instructions does."""
    found: Pieces = read_results(RECOMBINED, lambda o: (o["network"], o["variant"]))
    rows = []
    for preset in PRESETS:
        for variant, said in PRACTISED.items():
            if runs := found.get((preset, variant)):
                first, last = (outcomes(runs, name) for name in ("phase1", "phase2"))
                trained = [run["results"]["trained"]["phase2"]["counts"] for run in runs]
                shares = [counts["success"] / sum(counts.values()) for counts in trained]
                rows.append(
                    {
                        "preset": f"`{preset}`",
                        "practises": said,
                        "seeds": str(len(runs)),
                        "phase 1": brief(two_level_bootstrap(first)),
                        "phase 2": brief(two_level_bootstrap(last)),
                        "gain, points": brief(paired_difference(first, last)),
                        "trained pairs, phase 2": mean(shares, 1),
                    }
                )
    notes = commands_note(found.values())
    return "\n\n".join(part for part in (table(rows), notes) if part)


def part_row(said: str, runs: list[dict[str, Any]]) -> dict[str, str]:
    """Return what a variant does and sees."""
    found = [run["results"] for run in runs]
    row = {"": said}
    for part in ("held-out", "trained"):
        rate = brief(two_level_bootstrap(outcomes(runs, part)))
        each = ", ".join(f"{100 * one[part]['rate']['rate']:.0f}" for one in found)
        row[f"{part} pairs"] = f"{rate}<br>seeds: {each}" if len(runs) > 1 else rate
    for name, shown in PROBES.items():
        row[shown] = probed([one["probes"][name] for one in found])
    return row


def probed(found: list[dict[str, float] | None]) -> str:
    """Return the means over seeds of a probe on trained and on held-out pairs, in percent."""
    known = [one for one in found if one is not None]
    means = (100 * sum(one[part] for one in known) / len(known) for part in ("trained", "held_out"))
    return " / ".join(f"{mean:.0f}" for mean in means) if known else ""


def written() -> dict[Path, str]:
    """Return what each page should say."""
    tables = renewed(PAGE.read_text(), "tables", f"\n\n{content()}\n\n")
    zero_shot = ZERO_SHOT.read_text()
    parts = {
        "zero-shot": zero_shot_content(),
        "parts": parts_content(),
        "recombined": recombined_content(),
    }
    for mark, part in parts.items():
        zero_shot = renewed(zero_shot, mark, f"\n\n{part}\n\n")
    readme = renewed(README.read_text(), "zero-shot", f"\n{readme_zero_shot()}\n")
    readme = renewed(readme, "paper", f"\n{readme_tables()}\n")
    return {PAGE: tables, ZERO_SHOT: zero_shot, README: readme}


def main() -> None:
    for path, text in written().items():
        with atomic_write(path) as temporary:
            temporary.write_text(text)


if __name__ == "__main__":
    main()
