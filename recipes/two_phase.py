"""Both phases on one task, and a report: the main job.

python recipes/two_phase.py task=pick seed=1
"""

import math
from collections.abc import Callable

from _shared import load_demonstrations, open_run, simulator_of, world_of, write_result
from collect_transitions import collect
from controls import continue_imitation
from evaluate import evaluate
from imitate import imitate
from label import label
from record_demonstrations import record
from self_examine import examine
from train_goal import train_goal
from train_instruction import train_instruction
from train_inverse import train_inverse
from train_reward import train_reward

from ifo_grounding.attributes import untransformed
from ifo_grounding.cli import recipe_main
from ifo_grounding.config import STAGES, Options
from ifo_grounding.envs import GymnasiumEnv
from ifo_grounding.errors import UserError
from ifo_grounding.report import text_table
from ifo_grounding.report.results import conclusion, headline
from ifo_grounding.texts import one_line
from report import report


def two_phase(options: Options) -> dict:
    if options.references and options.recorded:
        raise UserError("references=true imitates true actions: recorded= holds none, leave it out")
    last = STAGES.index(options.until or STAGES[-1])
    rewarded = world_of(options).rewarded  # what cannot be made is refused before all else
    print(
        f"{one_line(options.task)}, {options.demonstrations.n:,} demonstrations: about "
        f"{math.ceil(expected_minutes(options))} min of a core; what is interrupted goes on",
        flush=True,
    )
    for name, stage in stages_of(options).items():
        if STAGES.index(name) <= last:
            stage(options)
        if name == "record_demonstrations" and (reason := phase_1_alone(options)):
            print(f"phase 1 alone: {reason}", flush=True)
            last = min(last, STAGES.index("imitate"))
    if last < STAGES.index("imitate") or not rewarded:
        return {}
    if options.controls.run and last == len(STAGES) - 1:
        continue_imitation(options)
    results = evaluate(options)
    if options.references:
        from baselines import references  # which begin with the stages below

        results = {**results, **references(options)}
    write_result(options, results, "demo")
    return results


def expected_minutes(options: Options) -> float:
    """Estimate how long a run takes on a CPU, by what its stages took on one core of a server.

    Time per step and per sample, in seconds; of slow simulators, their own time comes on top.
    """
    imitate, told, goal = options.imitate, options.instruction, options.goal
    tried = sum(imitate.trials / 2**k for k in range(imitate.trial_halvings + 1))
    steps = imitate.steps + (tried - 1) * imitate.trial_steps
    seconds = steps * (1.5e-2 + 1.2e-4 * imitate.batch_size)
    fresh = 32 if options.demonstrations.n < told.fresh_states else 0
    scored = (told.steps + (told.trials - 1) * told.trial_steps) * told.batch_size
    seconds += scored * (1 + told.negatives + fresh) * 1e-5
    seconds += goal.steps * goal.batch_size * 6e-4
    practised = options.self_examine
    seconds += practised.iterations * practised.num_envs * practised.steps * 4e-4
    searched = 10 * (practised.pairs or 0) * min(told.candidates, options.demonstrations.n)
    seconds += searched * 1.1e-5  # where one state in ten gets a pair
    seconds += options.evaluate.episodes * 8e-3
    return (20 + seconds * (4 if options.preset == "paper" else 1)) / 60


def phase_1_alone(options: Options) -> str | None:
    """Return why nothing could be learned in phase 2 from what was recorded, None if it can."""
    demos, by_goal = load_demonstrations(open_run(options)), options.self_examine.reward == "goal"
    if len(demos.pool()) < 2:
        return "all demonstrations have one instruction, so that there are none to choose between"
    if by_goal and not demos.closed.any():
        return "all demonstrations are cut short, so that no frame shows a goal that was reached"
    never_stops = by_goal and world_of(options).stop_action is None
    if never_stops and isinstance(untransformed(simulator_of(options)), GymnasiumEnv):
        return (
            "the world has no stop, at which the goal reward is paid: give the action that ends an "
            "episode (world.stop=2), or add one where none does (world.stop=add)"
        )
    return None


def stages_of(options: Options) -> dict[str, Callable[[Options], dict]]:
    by_action = options.self_examine.reward == "action"
    return {
        # Phase 1: imitation from observation. Demonstrations hold the words of many worlds.
        "record_demonstrations": record,
        "collect_transitions": collect,
        "train_inverse": train_inverse,
        "label": label,
        "imitate": imitate,
        # Phase 2: self-examination.
        "train_instruction": train_instruction,
        **({"train_reward": train_reward} if by_action else {"train_goal": train_goal}),
        "self_examine": examine,
    }


@recipe_main
def main(options: Options) -> dict:
    results = two_phase(options)
    if not results:
        if not world_of(options).rewarded:
            print(f"nobody knows success in this world: ifo-grounding play run={options.run}")
        return results
    page = report(options, results)
    table = [{"in unseen scenes": k, "[95% interval]": v} for k, v in headline(results).items()]
    print(f"\n{text_table(table)}\n\n{conclusion(results)}\nreport: {page}")
    return results


if __name__ == "__main__":
    main()
