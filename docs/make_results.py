"""Write the tables of results: ``python docs/make_results.py`` after ``results/`` has changed.

Reads ``results/*.json`` (the ``result.json`` of runs) and writes ``docs/results.md`` and the parts
of ``README.md`` and ``docs/babyai.md`` between two marks. A test checks that all are up to date.
"""

import functools
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.figure import Figure

from ifo_grounding._folder import recipes_folder
from ifo_grounding.files import atomic_write, read_json
from ifo_grounding.report import (
    audit_figure,
    compared_rates,
    markdown_table,
    rates_by_number,
    results_rows,
    save_figure,
)
from ifo_grounding.report.paper import EPISODES, TABLE_2
from ifo_grounding.report.results import (
    brief,
    commands_note,
    read_results,
    restored,
    same_policy,
)
from ifo_grounding.report.results import unpacked as outcomes
from ifo_grounding.report.tables import folded, renewed
from ifo_grounding.stats import Rate, holm, paired_difference, two_level_bootstrap, wilson
from ifo_grounding.tasks import TASKS

sys.path.append(str(recipes_folder()))
from _changes import changes

ROOT = Path(__file__).parents[1]
EARLIER = "†"
PICTURE = ROOT / "docs" / "assets" / "studies.png"
LEARNED = PICTURE.with_name("babyai.png")
EFFICIENCY = PICTURE.with_name("efficiency.png")
FEW = 2000
"""Demonstrations up to which the README shows a study: with more there is little left to gain."""
HACKED = ROOT / "results" / "study" / "move-200-film-action-centred-seed0.json"
NAMES = {
    "phase1": "phase 1",
    "continued": "imitation continued",
    "cloned": "accepted rollouts cloned",
    "phase2": "phase 2",
}

PHASES = ("phase1", "phase2")
NAMED = ("task", "demonstrations", "preset")
JUDGED = ("suitable", "served", "servable")
DECISIVE = ("transitions", "inverse", "imitate", "instruction", "reward", "goal", "self_examine")
"""Sections of the options that decide what is learned."""

BABYAI_POLICIES = {
    "bot": "demonstrator",
    "true actions": "true_actions",
    "phase 1": "phase1",
    "phase 2": "phase2",
}
LEVELS = ("GoToObj", "GoToLocal", "PickupLoc")
"""Levels of BabyAI that the page speaks of, run or not, with 1,000 demonstrations at least."""

NAMING = ("seed", "run", "base", "results", "variant")
"""Arguments that decide nothing, so that those of all seeds are the same without."""

Key = tuple[str, int, str, float]
"""Of a study: task, demonstrations, preset and variant, and the share held out."""


def runs() -> list[dict[str, Any]]:
    """Return all committed results, in the order of the tasks."""
    found = [read_json(path) for path in sorted((ROOT / "results").glob("*.json"))]
    return sorted(found, key=lambda result: TASKS.index(result["options"]["task"]))


def studies() -> dict[Key, list[dict[str, Any]]]:
    """Return the committed seeds of each study."""
    found = read_results(ROOT / "results" / "study", study_of)
    return dict(sorted(found.items(), key=lambda item: (TASKS.index(item[0][0]), item[0][1:])))


def study_of(options: Mapping[str, Any]) -> Key:
    """Return to which study a run belongs."""
    held_out = options["imitate"].get("held_out", 0.0)
    return options["task"], options["demonstrations"]["n"], preset_of(options), held_out


def preset_of(options: Mapping[str, Any]) -> str:
    """Return the preset of a run, with its variant where it has one."""
    variant = options.get("variant")
    return f"{options['network']}, {variant}" if variant else options["network"]


def study_section() -> list[str]:
    """Return what the studies over seeds found."""
    rows = study_rows()
    if not rows:
        return []
    return [
        "## Studies",
        "One to five training seeds each; greedy success on the same evaluation scenes in percent,"
        " with 95% intervals of a two-level bootstrap over seeds and scenes; differences are paired"
        " by scene. Where demonstrations were held out, their likelihood stopped phase 1"
        " ([too early](#variants-of-phase-1), as it turned out)."
        " `continued` and `cloned` are the [controls](phase2.md#controls). `phase 1 kept` says with"
        " how many seeds no look at what came after phase 1 found it better, so that it is phase 1"
        " that is compared. p is that of no gain, by"
        " a [t test over seeds](evaluation.md#intervals), of one seed by McNemar's, corrected"
        " (Holm) for the tasks with as many demonstrations. Practice of 60 iterations is with"
        " 10,000 states whose instructions are"
        " [chosen once](phase2.md#what-practice-gains-with-few).",
        f"![Success of each policy, with intervals](assets/{PICTURE.name})",
        markdown_table([shown(row, *JUDGED) for row in rows]),
        earlier_note(),
        "Of each seed the share of suitable instructions among those chosen, of states served, and"
        " of states that any instruction of the pool suits, by the oracle: the most that could be"
        " served.",
        markdown_table([{name: row[name] for name in (*NAMED, *JUDGED)} for row in rows]),
        commands_note(practised().values()),
    ]


def shown(row: dict[str, Any], *without: str) -> dict[str, Any]:
    """Return a row without some of its columns."""
    return {name: value for name, value in row.items() if name not in without}


@functools.cache
def study_rows() -> list[dict[str, Any]]:
    """Compare the policies of every study; resampling takes seconds, and two pages show it."""
    found = practised()
    rows = [study_row(key, runs) for key, runs in found.items()]
    return [{**row, "p": p} for row, p in zip(rows, adjusted(found), strict=True)]


def variant_section() -> list[str]:
    """Return what was compared of phase 2 on validation or evaluation scenes."""
    found = practised(variants=True)
    rows = [study_row(key, runs, scenes=True) for key, runs in found.items()]
    if not rows:
        return []
    return [
        "## Variants of phase 2",
        "What else was tried, from the same phase 1; the pages of the phases say why it does what"
        " it does.",
        markdown_table(rows),
        commands_note(found.values()),
    ]


def module_section() -> list[str]:
    """Return what was compared of the instruction module alone."""
    found = {
        key: runs
        for key, runs in studies().items()
        if "phase2" not in runs[0]["results"] and "suitability" in runs[0]["results"]
    }
    rows = []
    for (task, n, kind, _), runs in found.items():
        for run in runs:
            suitability = run["results"]["suitability"]
            rows.append(
                {
                    "task": task,
                    "demonstrations": f"{n:,}",
                    "instruction module": kind.rpartition(", ")[2],
                    "seed": run["options"]["seed"],
                    "scenes": run["options"]["evaluate"]["stream"],
                    "suitable": brief(restored(Rate, suitability["rate"])),
                    "served": brief(restored(Rate, suitability["served"])),
                }
            )
    if not rows:
        return []
    return [
        "## Instruction modules",
        "Suitable instructions among those chosen, and states served, by ways to train the"
        " [instruction module](phase2.md#the-instruction-module) from the same phase 1.",
        markdown_table(rows),
        commands_note(found.values()),
    ]


def imitation_section() -> list[str]:
    """Return what was compared of phase 1 alone."""
    found = {
        key: runs
        for key, runs in studies().items()
        if not {"phase2", "suitability"} & set(runs[0]["results"])
    }
    rows = []
    for (task, n, kind, _), runs in found.items():
        for run in runs:
            success, options = run["results"]["phase1"], run["options"]
            rows.append(
                {
                    "task": task,
                    "demonstrations": f"{n:,}",
                    "preset": options["network"],
                    "imitation": kind.partition(", ")[2] or kind,
                    "steps": f"{options['imitate']['steps']:,}",
                    "held out": f"{options['imitate']['held_out']:.0%}",
                    "seed": options["seed"],
                    "scenes": f"{success['rate']['count']:,} {options['evaluate']['stream']}",
                    "greedy": brief(restored(Rate, success["rate"])),
                    "sampled": brief(restored(Rate, success["sampled"]["rate"])),
                }
            )
    if not rows:
        return []
    return [
        "## Variants of phase 1",
        "When to [stop imitating](phase1.md#when-to-stop), and with and without the"
        " [prior](phase1.md#few-demonstrations), in batches of other sizes, from the best of six or"
        " of twelve beginnings.",
        markdown_table(rows),
        commands_note(found.values()),
    ]


def levels() -> dict[tuple[str, int, str], list[dict[str, Any]]]:
    """Return the committed seeds of each level of BabyAI, number of demonstrations and preset."""
    return read_results(
        ROOT / "results" / "babyai", lambda o: (o["task"], o["demonstrations"]["n"], preset_of(o))
    )


@functools.cache
def level_rows() -> dict[tuple[str, int, str], dict[str, Any]]:
    """Compare the policies of every level; resampling takes seconds, and three pages show it."""
    measured = level_rates()
    return {of: babyai_row(*of, runs, measured[of]) for of, runs in levels().items()}


def strong_levels() -> str:
    """Return the table of the preset `strong` in BabyAI, as two other pages show it."""
    known = {of: row for of, row in level_rows().items() if of[0] in LEVELS and of[2] == "strong"}
    rows = [known[of] for of in sorted(known, key=lambda of: (LEVELS.index(of[0]), of))]
    return (
        f"\n{markdown_table([{k: v for k, v in row.items() if k != 'preset'} for row in rows])}\n"
    )


def babyai_section() -> list[str]:
    """Return what was measured in the levels of BabyAI."""
    ran = levels()
    known = {level for level, _, _ in ran}
    waiting = {(of, 1000, ""): babyai_row(of, 1000, "", [], {}) for of in LEVELS if of not in known}
    order = [*LEVELS, *sorted(known.difference(LEVELS))]
    rows = {**waiting, **level_rows()}
    found = sorted(rows, key=lambda of: (order.index(of[0]), *of[1:]))
    return [
        "## BabyAI",
        "Greedy success by BabyAI's own reward in fixed rooms, in percent, with 95% intervals over"
        " seeds and rooms. [How it is set up](babyai.md). `true actions` imitates what the bot did"
        " in place of labels, which no learner may read: an upper reference for phase 1, as the bot"
        " itself is. Minutes are those of one core from recording to the end of the evaluation, the"
        " median of the seeds.",
        f"![Success against the number of demonstrations](assets/{LEARNED.name})",
        markdown_table([rows[of] for of in found]),
        *([commands_note(ran.values())] if ran else []),
    ]


def babyai_row(
    level: str, n: int, preset: str, runs: list[dict[str, Any]], measured: dict[str, Rate]
) -> dict[str, Any]:
    """Compare both phases in one level with their references."""
    row: dict[str, Any] = {"level": level, "demonstrations": f"{n:,}", "preset": preset}
    row["seeds"] = len(runs)
    for title in BABYAI_POLICIES:
        row[title] = brief(measured[title]) if title in measured else "not run"
    row["gain, points"] = "not run"
    if row["phase 2"] != "not run":
        both = (outcomes(runs, name) for name in ("phase1", "phase2"))
        row["gain, points"] = brief(paired_difference(*both))
    row["minutes"] = round(median(map(minutes, runs))) if runs else "not run"
    return row


def minutes(run: dict[str, Any]) -> float:
    """Return how long the method and its evaluation took, without the references."""
    aside = ("imitate_truth", "evaluate_references")
    return (run["seconds"] - sum(run["stages"].get(stage, 0.0) for stage in aside)) / 60


@functools.cache
def level_rates() -> dict[tuple[str, int, str], dict[str, Rate]]:
    """Return of every level how often each policy that was run with every seed succeeds."""
    return {
        of: {
            title: two_level_bootstrap(outcomes(runs, name))
            for title, name in BABYAI_POLICIES.items()
            if all(name in run["results"] for run in runs)
        }
        for of, runs in levels().items()
    }


def babyai_picture() -> Figure:
    """Draw success against the number of demonstrations, of the preset `strong`."""
    panels: dict[str, dict[str, dict[int, Rate]]] = {level: {} for level in LEVELS}
    for (level, n, preset), rates in sorted(level_rates().items()):
        if preset == "strong" and level in panels:
            for title, rate in rates.items():
                panels[level].setdefault(title, {})[n] = rate
    bots = {level: curves.pop("bot", {}) for level, curves in panels.items()}
    return rates_by_number(
        panels,
        references={level: {"bot": max(bot.items())[1].rate} for level, bot in bots.items() if bot},
    )


def practised(variants: bool = False) -> dict[Key, list[dict[str, Any]]]:
    """Return the studies whose policy has practised: those of the presets, or their variants."""
    return {
        key: runs
        for key, runs in studies().items()
        if "phase2" in runs[0]["results"] and (", " in key[2]) == variants
    }


def study_row(key: Key, runs: list[dict[str, Any]], scenes: bool = False) -> dict[str, Any]:
    """Compare the policies of one study over its seeds."""
    task, n, kind, held_out = key
    both = outcomes(runs, "phase1"), outcomes(runs, "phase2")
    stream = f" {runs[0]['options']['evaluate']['stream']}" if scenes else ""
    row = {
        "task": task,
        "demonstrations": f"{n:,}",
        "preset": f"{kind}, {held_out:.0%} held out" if held_out else kind,
        "seeds": f"{len(runs)}{EARLIER}" if not scenes and any(map(earlier, runs)) else len(runs),
        "scenes": f"{both[0].shape[1]:,}{stream}",
        "iterations": runs[0]["options"]["self_examine"]["iterations"],
        "phase 1": brief(two_level_bootstrap(both[0])),
        "phase 2": brief(two_level_bootstrap(both[1])),
        "gain, points": brief(paired_difference(*both)) + kept("phase2", runs),
    }
    for name in ("continued", "cloned"):
        row[f"over {name}"] = over_control(name, runs)
    suitable = [run["results"]["suitability"] for run in runs]
    row["suitable"] = ", ".join(f"{100 * s['rate']['rate']:.1f}" for s in suitable)
    row["served"] = ", ".join(f"{100 * s['served']['rate']:.0f}" for s in suitable)
    row["servable"] = ", ".join(f"{100 * s['servable']['rate']:.0f}" for s in suitable)
    return row


def over_control(name: str, runs: list[dict[str, Any]]) -> str:
    """Return how far phase 2 is ahead of a control, of the seeds that ran it."""
    having = [run for run in runs if name in run["results"]]
    if not having:
        return "not run"
    ahead = brief(paired_difference(outcomes(having, name), outcomes(having, "phase2")))
    if len(having) < len(runs):
        gain = paired_difference(outcomes(having, "phase1"), outcomes(having, "phase2"))
        ahead += f" ({len(having)} of {len(runs)} seeds, gain {gain.points:+.1f})"
    return ahead + kept(name, having)


def kept(name: str, runs: list[dict[str, Any]]) -> str:
    """Say with how many seeds a policy is that of phase 1, for nothing after it was kept."""
    same = sum(same_policy(run, name) for run in runs)
    return f"; phase 1 kept: {same} of {len(runs)}" if same else ""


def earlier(run: Mapping[str, Any]) -> list[str]:
    """Return which options that decide what is learned are others today."""
    said = [text for text in run["command"].split()[3:] if text.partition("=")[0] not in NAMING]
    return changes(run["options"], said, DECISIVE)


def earlier_note() -> str:
    """Say which studies were made with other options than presets and budgets have today."""
    told: dict[tuple[str, ...], list[str]] = {}
    for (task, n, kind, _), runs in practised().items():
        of_seeds = Counter(tuple(earlier(run)) for run in runs)
        for said, count in of_seeds.items():
            seeds = f" ({count} of {len(runs)} seeds)" if count < len(runs) else ""
            told.setdefault(said, []).append(f"{task} {n:,} {kind}{seeds}")
    lines = [f"- {', '.join(who)}: {', '.join(said)}" for said, who in told.items() if said]
    return folded(f"{EARLIER}: made with other options than presets and budgets have today", lines)


def adjusted(found: dict[Key, list[dict[str, Any]]]) -> list[str]:
    """Return the p-value of each study's gain, corrected for all with as many demonstrations."""
    groups: dict[tuple[int, str, float], list[Key]] = {}
    for key in found:
        groups.setdefault(key[1:], []).append(key)
    corrected = {}
    for members in groups.values():
        tests = [
            paired_difference(outcomes(found[key], "phase1"), outcomes(found[key], "phase2"))
            for key in members
        ]
        corrected |= dict(zip(members, holm([test.p_value for test in tests]), strict=True))
    return [f"{p:.2g}" if (p := corrected[key]) >= 1e-4 else "< 0.0001" for key in found]


def efficient() -> dict[str, dict[int, dict[str, Rate]]]:
    """Return of each task what `strong` reaches by number of demonstrations, two or more.

    What the paper's tables show comes on top for the tasks that have studies.
    """
    found: dict[str, dict[int, dict[str, Rate]]] = {}

    def add(task: str, n: int, runs: list[dict[str, Any]]) -> None:
        rates = {name: two_level_bootstrap(outcomes(runs, name)) for name in PHASES}
        found.setdefault(task, {})[n] = rates

    for (task, n, kind, held_out), runs in practised().items():
        if kind == "strong" and not held_out:
            add(task, n, runs)
    found = {task: by for task, by in found.items() if len(by) > 1}
    tabled = read_results(
        ROOT / "results" / "tables",
        lambda o: (o["task"], o["demonstrations"]["n"], o["network"], o["variant"]),
    )
    for (task, n, kind, variant), runs in tabled.items():
        if (kind, variant) == ("strong", "pairs-5000") and task in found:
            add(task, n, runs)
    return {task: dict(sorted(by.items())) for task, by in found.items()}


def best_of_paper(task: str) -> float:
    """Return the paper's best rate of a task: after phase 2, with 80,000 demonstrations."""
    return max(TABLE_2[task]) / 100


def efficiency_section() -> list[str]:
    """Return how success grows with the number of demonstrations."""
    found = efficient()
    if not found:
        return []
    rows = []
    for task, numbers in found.items():
        told = wilson(round(best_of_paper(task) * EPISODES), EPISODES)
        row = {"task": task, "paper, 80,000": brief(told), "fewest tried": f"{min(numbers):,}"}
        for name in PHASES:
            ahead = [n for n, rates in numbers.items() if rates[name].low > told.high]
            row[f"{NAMES[name]} beats it with"] = f"{min(ahead):,}" if ahead else "none"
        rows.append(row)
    return [
        "## Data efficiency",
        "The same studies by number of demonstrations, preset `strong`. The dashed line is the"
        " paper's best policy, after its phase 2 with 80,000 demonstrations. Up to 500 are imitated"
        " with the [prior](phase1.md#few-demonstrations); of those with more, most are from before"
        " it."
        " With 80,000 they are those of [the paper's tables](tables.md), which learn for longer.",
        f"![Success against the number of demonstrations](assets/{EFFICIENCY.name})",
        "The fewest of the tried numbers of demonstrations with which an interval lies above that"
        " of the paper, whose rates look like 500 episodes:",
        markdown_table(rows),
    ]


def efficiency_picture() -> Figure:
    """Draw success against the number of demonstrations, beside the paper's best."""
    found = efficient()
    panels = {
        task: {NAMES[name]: {n: rates[name] for n, rates in by.items()} for name in PHASES}
        for task, by in found.items()
    }
    references = {task: {"paper, 80,000": best_of_paper(task)} for task in panels}
    return rates_by_number(panels, references=references)


def study_picture() -> Figure:
    """Draw what the studies compare that ran their controls."""
    groups = {}
    for (task, n, kind, held_out), runs in practised().items():
        if "cloned" not in runs[0]["results"]:
            continue
        known = [name for name in NAMES if all(name in run["results"] for run in runs)]
        aside = f", {held_out:.0%} held out" if held_out else ""
        title = f"{task}, {n:,} demonstrations{aside}, {kind}, seeds: {len(runs)}"
        groups[title] = {NAMES[name]: two_level_bootstrap(outcomes(runs, name)) for name in known}
    return compared_rates(groups)


def hacking_picture() -> Figure | None:
    """Draw the audit of the run that the page of phase 2 shows as an example of reward hacking."""
    return audit_figure(read_json(HACKED)["audit"]) if HACKED.exists() else None


def page(found: list[dict[str, Any]]) -> str:
    """Return the page of results."""
    parts = [
        "---\nhide: [toc]\n---",  # its tables are wide
        "# Results",
        "Every number here comes from a file under `results/`, which holds all options, the seed,"
        " the commit and the machine. `python docs/make_results.py` writes this page from them.",
    ]
    parts += study_section() + efficiency_section() + babyai_section()
    parts += variant_section() + module_section() + imitation_section()
    for run in found:
        made = run["provenance"]
        parts += [
            f"## A run of the demo: {run['options']['task']}",
            f"`{run['command']}`, seed {run['options']['seed']}, commit `{made['commit']}`, "
            f"{made['machine']} ({made['cores']} cores, torch threads: {made['threads']}), torch "
            f"{made['torch']}, {run['seconds'] / 60:.1f} minutes, scenes "
            f"`{run['results']['phase1']['scenes'][:16]}`.",
            markdown_table(results_rows(run["results"])),
        ]
    return "\n\n".join(parts) + "\n"


def readme(text: str) -> str:
    """Return the README with its tables of studies and of BabyAI renewed."""
    aside = ("preset", "scenes", *JUDGED)
    found = zip(practised(), study_rows(), strict=True)
    few = [row for (_, n, kind, _), row in found if n <= FEW and kind == "strong"]
    rows = [shown(row, *aside) for row in few]
    said = "made with other options than `strong` has today: [which](docs/results.md#studies)."
    note = f"\n{EARLIER} {said}\n" if any(EARLIER in str(row["seeds"]) for row in rows) else ""
    text = renewed(text, "results", f"\n{markdown_table(rows)}\n{note}")
    return renewed(text, "babyai", strong_levels())


def written() -> dict[Path, str]:
    """Return what each file should say."""
    found = runs()
    path = ROOT / "README.md"
    levelled = ROOT / "docs" / "babyai.md"
    return {
        ROOT / "docs" / "results.md": page(found),
        path: readme(path.read_text()),
        levelled: renewed(levelled.read_text(), "babyai", strong_levels()),
    }


def main() -> None:
    for path, text in written().items():
        with atomic_write(path) as temporary:
            temporary.write_text(text)
    if studies():
        save_figure(study_picture(), PICTURE)
    if efficient():
        save_figure(efficiency_picture(), EFFICIENCY)
    if levels():
        save_figure(babyai_picture(), LEARNED)
    if (hacked := hacking_picture()) is not None:
        save_figure(hacked, PICTURE.with_name("hacking.png"))


if __name__ == "__main__":
    main()
