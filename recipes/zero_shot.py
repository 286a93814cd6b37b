"""Zero-shot, one part at a time: what the preset `strong` owes to each of its parts.

And what common remedies do for `film`, which hears a sentence as one vector. With
``world.holdout_visible=false`` objects of held-out pairs are absent from what is learned from, so
that nothing says that they are never meant: variants of their own.

python recipes/zero_shot.py task=move seed=0
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from _results import check_result, keep_result, write_result
from _shared import changed_networks, open_run, open_stage
from _worlds import open_world
from collect_transitions import collect
from evaluate import evaluation_scenes
from imitate import best_beginning, labelled_demonstrations
from label import label
from omegaconf import DictConfig
from record_demonstrations import record
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from train_inverse import train_inverse

from ifo_grounding import keys
from ifo_grounding.cli import recipe_main
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.evaluation import episode_endings, probe
from ifo_grounding.evaluation.endings import SUCCESS
from ifo_grounding.networks import ColourAndForm, GroundedTrunk, make_policy
from ifo_grounding.networks.appearance import EVIDENCE
from ifo_grounding.networks.appearance import Appearance as Looks
from ifo_grounding.networks.warm_start import trunk_of
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.report import text_table
from ifo_grounding.report.results import brief, by_scene, restored
from ifo_grounding.stats import Rate


class SeenWhole(ColourAndForm):
    """Sees a cell as a whole: for words, for the silent heads, or for both."""

    def __init__(self, channels: int, features: int, patch: int, for_words: bool) -> None:
        super().__init__(channels, features, patch)
        self.for_words = for_words
        self.look = nn.Sequential(nn.Linear(channels * patch**2, features), nn.ReLU())
        self.apart = nn.Linear(features, 2 * EVIDENCE)

    def forward(self, image: Tensor) -> Looks:
        """See an image [N, C, H, W], its distinct cells once."""
        looks = super().forward(image)
        tiles, _ = self.tiles(image)
        seen = self.look(tiles.flatten(1))
        if not self.for_words:
            return looks._replace(silhouette=seen)
        colour, form = (F.layer_norm(e, (EVIDENCE,)) for e in self.apart(seen).chunk(2, -1))
        return looks._replace(colour=colour, form=form)


def see_whole(for_words: bool) -> Callable[[GroundedTrunk, ImitationLoss], None]:
    def change(trunk: GroundedTrunk, loss: ImitationLoss) -> None:
        looks = trunk.looks
        trunk.looks = SeenWhole(looks.channels, looks.outline.out_features, looks.patch, for_words)

    return change


def one_way(trunk: GroundedTrunk, loss: ImitationLoss) -> None:
    trunk.both_ways = False


def no_charge(trunk: GroundedTrunk, loss: ImitationLoss) -> None:
    loss.word_penalty = 0.0


def no_swaps(trunk: GroundedTrunk, loss: ImitationLoss) -> None:
    trunk.words.swapped = 0.0


def no_noise(trunk: GroundedTrunk, loss: ImitationLoss) -> None:
    trunk.words.noise = 0.0


CHANGES: dict[str, Callable[[GroundedTrunk, ImitationLoss], None]] = {
    "cells-whole": see_whole(for_words=True),
    "silent-whole": see_whole(for_words=False),
    "no-charge": no_charge,
    "no-swaps": no_swaps,
    "no-noise": no_noise,
    "one-way": one_way,
}


class JitteredLoss(ImitationLoss):
    """Imitates pictures whose colour channels are brighter or darker, drawn anew at each step."""

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        pixels = tensordict.get(keys.PIXELS)
        gain = torch.empty(pixels.shape[-3], 1, 1, device=pixels.device).uniform_(0.5, 1.5)
        seen = (pixels * gain).clamp_(0, 255).to(torch.uint8)
        return super().forward(tensordict.copy().set(keys.PIXELS, seen))


@dataclass(frozen=True)
class Sentence:
    """What is changed of the preset `film`, or of how it learns."""

    network: dict[str, Any] = field(default_factory=dict)
    imitate: dict[str, Any] = field(default_factory=dict)
    loss: type[ImitationLoss] = ImitationLoss


SENTENCES = {
    "sentence": Sentence(),
    "sentence-narrow": Sentence(network={"features": 16}),
    "sentence-dropout": Sentence(network={"dropout": 0.5}),
    "sentence-decay": Sentence(imitate={"weight_decay": 1.0}),
    "sentence-early": Sentence(imitate={"steps": 300, "trials": 1}),
    "sentence-jitter": Sentence(loss=JitteredLoss),
}
WHOLE = "whole"
VARIANTS = (WHOLE, *CHANGES, *SENTENCES)
"""The whole preset, what is changed in one part alone, and the preset `film` with remedies."""


def compare(options: DictConfig) -> dict[str, dict]:
    """Imitate the same demonstrations with each variant, and measure what it does and sees."""
    for name in options.variants:
        check_choice("variant", name, VARIANTS)
    if options.simulator != "grid":
        raise UserError("held-out pairs are of the grid: leave world=babyai out")
    if options.network != "strong":
        raise UserError(f"variants are of preset strong: leave preset={options.network} out")
    for prepare in (collect, train_inverse, record, label):
        prepare(options)
    seen, held_out = labelled_demonstrations(open_run(options), options.imitate.held_out)
    return {name: imitate_with(name, seen, held_out, options) for name in options.variants}


def imitate_with(
    name: str, seen: ReplayBuffer, held_out: ReplayBuffer | None, options: DictConfig
) -> dict:
    """Imitate with one variant and keep what was measured."""
    options.variant = name if options.world.holdout_visible else f"{name}-absent"
    check_result(options)
    if name in SENTENCES:
        options = options.copy()
        options.imitate.update(SENTENCES[name].imitate)
    stage = open_stage(options, f"zero-shot-{name}", ["imitate", "evaluate"], ["label"])
    results = stage.result
    if results is None:
        build = functools.partial(beginning, name)
        best = best_beginning(options, stage, seen, held_out, build)
        best.learn()
        results = stage.finish(measured(best.loss.network, options))
    used = options.copy()
    if name in SENTENCES:
        used.network = "film"
        used.networks.update(SENTENCES[name].network)
    keep_result(options, write_result(used, results, "run zero_shot"))
    return results


def beginning(name: str, options: DictConfig, seed: int) -> ImitationLoss:
    """Build a variant with the initial weights of a seed."""
    world = open_world(options).simulator()
    chosen = {"seed": seed, "device": options.device, **changed_networks(options)}
    if name in SENTENCES:
        what = SENTENCES[name]
        return what.loss(make_policy(world, "film", **{**chosen, **what.network}))
    loss = ImitationLoss(make_policy(world, "strong", **chosen))
    if name in CHANGES:
        trunk = trunk_of(loss.network)
        assert isinstance(trunk, GroundedTrunk)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            CHANGES[name](trunk, loss)
        trunk.to(options.device)
    return loss


def measured(policy: nn.Module, options: DictConfig) -> dict[str, Any]:
    """Measure success on held-out and trained pairs, how episodes end, and the probes."""
    world, section = open_world(options), options.evaluate
    results: dict[str, Any] = {}
    for name, split in (("held-out", "zero-shot"), ("trained", "train")):
        scenes = {**evaluation_scenes(options), "split": split}
        place, shown = world.played(section.episodes, **scenes)
        ends = episode_endings(policy, place, **shown)
        results[name] = {**ends.as_dict(), **by_scene(ends.kind == SUCCESS)}
    asked = world.arguments(seed=section.seed, stream=section.stream)
    for decided in ("split", "holdout_visible"):  # by what is probed
        del asked[decided]
    results["probes"] = probe(policy, options.task, **asked).as_dict()
    return results


@recipe_main
def main(options: DictConfig) -> None:
    parts = ("held-out", "trained")
    rows = [
        {"variant": name, **{part: brief(restored(Rate, found[part]["rate"])) for part in parts}}
        for name, found in compare(options).items()
    ]
    print(text_table(rows))


if __name__ == "__main__":
    main()
