"""A rival of the paper's Table 1, with exactly the access it is allowed.

python recipes/baselines.py method=agile task=pick
"""

import math
from dataclasses import replace
from typing import Any

from _shared import (
    INVERSE,
    POLICIES,
    REFERENCE,
    TRANSITIONS,
    build,
    checksums,
    coded_simulator,
    finish,
    load_demonstrations,
    load_labels,
    load_network,
    open_run,
    open_stage,
    plain,
    read_fast,
    reading_codes,
    save_network,
    simulator_of,
    tell,
    world_of,
    write_result,
)
from evaluate import measured_success, played, success_results
from imitate import (
    imitate_transitions,
    imitate_truth,
    new_policy,
    split_transitions,
    true_actions,
)
from self_examine import chosen_starts
from torchrl.data import ReplayBufferEnsemble
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import RandomPolicy
from two_phase import stages_of

from ifo_grounding.baselines import (
    AGILE,
    GAIL,
    LCRL,
    ActionDemonstrations,
    Adversary,
    ChosenAGILE,
    GAIfO,
    SteppableActionDemonstrations,
    SteppableDemonstrations,
    steps_of_policy,
)
from ifo_grounding.baselines.config import METHODS, PLANNED, REFERENCES
from ifo_grounding.cli import recipe_main
from ifo_grounding.config import STAGES, Options
from ifo_grounding.data import Collected, label_demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import success_rate
from ifo_grounding.files import read_json, write_json
from ifo_grounding.networks import make_value
from ifo_grounding.objectives import InverseLoss
from ifo_grounding.report.results import by_scene, restored
from ifo_grounding.stats import Rate
from ifo_grounding.training import Run, Stage, fit, improve_policy
from ifo_grounding.training.checkpoint import difference

ENTROPY = 0.01
"""Weight of the entropy bonus of a policy that learns from a discriminator."""
UNSEEN = 200
"""Demonstrations of validation scenes that a discriminator is asked about in the end."""
MADE = {"bc": REFERENCE, "bco": POLICIES["phase1"], "ours": POLICIES["phase2"]}
"""Files of methods that are stages of a run."""
ACTED = ("bc", "lc-rl", "gail", "gail+bc")
"""Methods that need true actions."""
ROWS = 32
"""Worlds through which LC-RL walks side by side."""
ADVERSARIES: dict[str, type[Adversary]] = {
    "gail": GAIL,
    "gail+bc": GAIL,
    "gaifo": GAIfO,
    "agile": AGILE,
    "agile-chosen": ChosenAGILE,
}


def baseline(options: Options) -> dict[str, Any]:
    """Train a method, if it is not yet, and measure it on the evaluation scenes."""
    if options.method == "lc-rl" and options.task not in PLANNED:
        raise UserError(f"lc-rl plans the arm's cells: task={' or task='.join(PLANNED)}")
    for name, make in stages_of(options).items():
        if STAGES.index(name) <= STAGES.index(METHODS[options.method]):
            make(options)
        if name == STAGES[0] and options.method in ACTED:
            true_actions(open_run(options))  # where there are none, that is said before phase 1
    run = open_run(options)
    learned = trained(options)
    policy = checksums(run).get(file_of(options.method))  # trained anew, it is measured anew
    asked = {"options": plain(options.evaluate), "policy": policy}
    stage = open_stage(options, f"evaluate_{options.method}", of=asked)
    if stage.result is not None:
        return stage.result["results"]
    results = measured(learned, options)
    if curve := learning_curve(run, options.method):
        results["curve"] = curve
    trained_in = run.stage(f"baseline_{options.method}").result or {}
    if said := trained_in.get("discriminator"):
        results["discriminator"] = said
    finish(options, stage, {"of": asked, "results": results})
    return results


def measured(learned: Any, options: Options) -> dict[str, Any]:
    """Measure what a method has learned on the evaluation scenes."""
    scenes = options.evaluate
    if isinstance(learned, LCRL):
        env, _ = played(replace(options, device="cpu"), scenes.episodes)  # where it plans
        env.set_seed(scenes.seed)
        return {options.method: by_scene(learned.success(env, scenes.episodes))}
    if options.method == "expert":
        of = {"seed": scenes.seed, "stream": scenes.stream}
        return {options.method: by_scene(world_of(options).demonstrator(scenes.episodes, **of))}
    return success_results(measured_success({options.method: learned}, options))


def learning_curve(run: Run, method: str) -> list[list[float]]:
    """Return pairs of frames and success on validation scenes, of methods by policy gradient."""
    found, frames = [], 0.0
    for row in run.metrics("self_examine" if method == "ours" else f"baseline_{method}"):
        frames += row.get("frames", 0)
        if "success" in row:
            found.append([frames, row["success"]])
    return found


def trained(options: Options) -> Any:
    """Return what a method has learned, a policy mostly; it learns now if it has to."""
    method = options.method
    if method == "expert":
        return None
    if method == "random":
        env, _ = played(options, options.evaluate.episodes)
        return RandomPolicy(env.action_spec)
    if method == "lc-rl":
        return planned(options)
    if method in ("bc", "gail+bc"):
        imitate_truth(options)
    run = open_run(options)
    if method in ADVERSARIES or method == "bco-alpha":
        train = bco_alpha if method == "bco-alpha" else adversarial
        if (stage := trained_by(options)).result is None:
            train(options, stage)
    made_by = () if method in MADE else ("baselines", f"baseline_{method}")
    return load_network(run, file_of(method), options, made_by)


def references(options: Options) -> dict[str, Any]:
    """Return what phase 1 is compared with: imitation of true actions, and the demonstrator."""
    return {
        name: baseline(replace(options, method=method))[method]
        for name, method in REFERENCES.items()
    }


def file_of(method: str) -> str:
    """Return the file of what a method has learned."""
    return MADE.get(method, f"policy-{method}.safetensors")


def bco_alpha(options: Options, stage: Stage) -> None:
    """Imitate anew, with labels of an inverse model that has learned from the policy's steps."""
    run, world, section = stage.run, world_of(options), options.transitions
    if (size := options.inverse.batch_size) % 2:
        raise UserError(f"bco-alpha draws half of each batch: inverse.batch_size={size} is odd")
    demos = load_demonstrations(run)
    own = steps_of_policy(
        simulator_of(options, section.num_envs),
        load_network(run, POLICIES["phase1"], options),
        demos.pool(),
        math.ceil(options.baseline.alpha * section.n),
        stop_action=world.stop_action,
        seed=options.seed,
        progress=options.progress,
    )
    random = Collected.load(run.need(TRANSITIONS, "collect_transitions"))
    inverse = load_network(run, INVERSE, options)
    both = ReplayBufferEnsemble(random.buffer, own.buffer, sample_from_all=True)  # half of each
    fit(InverseLoss(inverse), both, options.inverse, seed=options.seed, name=stage.name)
    _, report = label_demonstrations(demos, inverse, progress=options.progress)
    changed = float((report.actions != load_labels(run)).float().mean())
    seen, held_out = split_transitions(demos, report.actions, options.imitate.held_out)
    found = {"of": options.baseline.read_by("bco-alpha"), "labels_changed": changed}
    imitate_transitions(options, stage, seen, held_out, file_of("bco-alpha"), **found)


def planned(options: Options) -> LCRL:
    """Return LC-RL with the reward that it learned, learned now if it has to be."""
    stage, world = trained_by(options), world_of(options)
    run, demos = stage.run, load_demonstrations(stage.run)
    env = world.steppable(ROWS, seed=options.seed)
    truth = true_actions(run)
    seen = SteppableActionDemonstrations(SteppableDemonstrations(demos, env), truth)
    how = {"seed": options.seed, **options.networks.changed()}
    planner = LCRL(seen, options.world["size"], options.preset, **how)
    file = file_of("lc-rl")
    if stage.result is None:
        found = planner.learn(options.baseline.likelihood_steps, ROWS, options.seed)
        save_network(run, file, planner.network)
        finish(options, stage, {"of": options.baseline.read_by("lc-rl"), **found})
    trained = load_network(run, file, options, ("baselines", stage.name))
    planner.network.load_state_dict(trained.state_dict())
    return planner


def trained_by(options: Options) -> Stage:
    """Return the stage that trains a method; one that was begun otherwise is refused."""
    method, section = options.method, options.baseline.read_by(options.method)
    stage = open_stage(options, f"baseline_{method}")
    begun, made = stage.checkpoint.with_name("begun.json"), section
    if stage.result is not None:
        made = stage.result["of"]
    elif begun.exists() and any(begun.parent.glob("*.pt")):
        made = read_json(begun, dict)
    made = {name: made[name] for name in section}
    if change := difference({"baseline": made}, {"baseline": section}):
        raise UserError(f"{method} was {change}, or give base={options.run} and another run=")
    if stage.result is None:
        write_json(begun, section)
    return stage


def adversarial(options: Options, stage: Stage) -> None:
    """Train a policy against a discriminator; see :mod:`ifo_grounding.baselines`."""
    method, section = options.method, options.baseline
    run, world = stage.run, world_of(options)
    begun = method == "gail+bc"
    policy = load_network(run, REFERENCE, options) if begun else new_policy(options, options.seed)
    value = build(make_value, options, init_from=policy)
    practice = ADVERSARIES[method].practice(options.self_examine)
    worlds, rounds = practice.num_envs, practice.num_envs * practice.steps
    seen, more = access(options, run, worlds), options.networks.changed()
    if method == "gaifo":
        more["inverse"] = load_network(run, INVERSE, options)
    adversary = ADVERSARIES[method](
        seen,
        options.preset,
        steps=section.steps,
        lr=section.lr,
        gamma=practice.gamma,
        stop_action=world.stop_action,
        shapes=policy.network_config.shapes,
        prior=options.instruction.prior,
        seed=options.seed,
        device=options.device,
        **more,
    )
    read_fast(adversary.demonstrations, options)
    reading_codes(adversary.network, options)
    iterations = math.ceil(section.frames / rounds)
    config = replace(
        practice,
        iterations=iterations,
        anneal=False,  # the reward goes on changing
        entropy=ENTROPY,
        value_warmup=min(practice.value_warmup, iterations - 1) if begun else 0,
        select_every=0,
        evaluate_every=math.ceil(iterations / 20),
    )
    if method == "agile":
        env = seen.starts(options.seed)
    else:
        env = TransformedEnv(coded_simulator(options, worlds), chosen_starts(run, options))
    history = improve_policy(
        env.append_transform(adversary.reward),
        policy,
        value,
        config,
        seed=options.seed,
        adversarial=adversary,
        checkpoint=stage.checkpoint,
        checkpoint_seconds=options.checkpoint_seconds,
        log=stage.log(),
        callback=validation_success(policy, options),
        progress=options.progress,
        cudagraph=True,
    )
    save_network(run, file_of(method), policy)
    said = {of: history[-1][f"reward/{of}_probability"] for of in ("demonstrated", "policy")}
    if not options.recorded:
        unseen, truth = world.demonstrate(UNSEEN, seed=options.seed, stream="validation")
        acted = adversary.access is ActionDemonstrations
        shown = ActionDemonstrations(unseen, truth) if acted else unseen
        said["unseen"] = adversary.probability(shown)
    found = {"of": section.read_by(method), **history[-1], "discriminator": said}
    finish(options, stage, found, history)


def access(options: Options, run: Run, worlds: int) -> Any:
    """Return what a method may use of the demonstrations, steps in so many worlds at once."""
    demos, kind = load_demonstrations(run), ADVERSARIES[options.method].access
    if kind is ActionDemonstrations:
        return ActionDemonstrations(demos, true_actions(run))
    if kind is SteppableDemonstrations:
        env = world_of(options).steppable(worlds, seed=options.seed, device=options.device)
        return SteppableDemonstrations(demos, env)
    return demos


def validation_success(policy: Any, options: Options) -> Any:
    """Return what measures the greedy policy on validation scenes, for the curve alone."""
    env, shown = played(options, options.evaluate.audit_episodes, stream="validation", split="all")
    return lambda step: {"success": success_rate(policy, env, **shown).rate.rate}


@recipe_main
def main(options: Options) -> dict:
    results = baseline(options)
    named = replace(options, variant="-".join(filter(None, [options.variant, options.method])))
    write_result(named, results, "run baselines", f"result-{options.method}.json")
    tell({options.method: restored(Rate, results[options.method]["rate"])})
    return results


if __name__ == "__main__":
    main()
