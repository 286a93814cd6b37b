"""A trained agent in a scene: what it is told, what it does, and what was learned says of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.envs.base import begin
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import Trace, record_episodes, trace_episode
from ifo_grounding.modules import TURNS, evaluating, output_key
from ifo_grounding.tasks import Vocabulary, grammar
from ifo_grounding.tasks.vocabulary import words_of
from ifo_grounding.world import WorldState, step
from ifo_grounding.worlds import OpenGrid, World

STREAM = "evaluation"
"""Scenes that no learner has seen."""
MOST_STEPS = 200
"""Of an episode in a world that sets no limit of its own."""
CHARACTERS = 300
"""That a sentence may have."""
SHOWN = 500
"""Instructions of the pool that are compared with a scene at most."""
REASONS = {
    "suitable": "it suits this scene",
    "missing": "something that it names is not here",
    "ambiguous": "something that it names is here more than once",
    "out of bounds": "the place that it names lies outside the grid",
    "occupied": "the place that it names is taken",
    "already true": "it is so already",
    "unachievable": "it cannot be done in time",
}
"""What the oracle's verdicts mean, in words."""


def taught_in(world: Mapping[str, Any]) -> tuple[str, ...]:
    """Return options of a command that trains from a person's demonstrations in a world.

    Args:
        world: its options, with its class as ``_target_``.

    >>> taught_in({"_target_": "own.Dial", "marks": None})[1:4]
    ('world._target_=own.Dial', '+world.marks=null', '+world.rewarded=False')
    """
    world = {**world, "rewarded": False}  # nobody else knows what the person means
    given = [
        f"{'' if name == '_target_' else '+'}world.{name}={'null' if value is None else value}"
        for name, value in world.items()
    ]
    return ("world=own", *given, "task=taught", "budget=demo")


class Suited(NamedTuple):
    """Whether a sentence suits a scene."""

    probability: float | None
    """By the instruction classifier; None without any."""
    truth: str | None
    """By the oracle, in words; None where nobody knows."""


@dataclass(frozen=True)
class Played:
    """What a policy did in a scene, with what decided it."""

    trace: Trace
    """Its episode of T steps, and what the policy looked at."""
    states: list[WorldState]
    """The T + 1 worlds [1] of the library's own grid; of other worlds none."""
    values: list[float]
    """Return that the value network expects at each of T steps; empty without any."""
    fulfilled: float | None
    """Probability that the last frame fulfils the sentence, by the goal classifier."""
    success: bool | None
    """Whether it does in truth; None where nobody knows."""


@dataclass(frozen=True)
class Agent:
    """Networks that were trained together, in their world."""

    world: World
    """Where it acts."""
    policies: Mapping[str, nn.Module]
    """One or two policies, by what they learned from: ``imitation``, ``self-examination``."""
    pool: Tensor
    """The instructions that it learned, int64 [P, L]."""
    instruction: Any = None
    """Its instruction classifier."""
    goal: Any = None
    """Its goal classifier."""
    value: Any = None
    """Its value network."""
    inverse: Any = None
    """Its inverse model."""
    teach: Sequence[str] = taught_in({"_target_": "ifo_grounding.worlds.OpenGrid"})
    """Options of a command that trains from a person's demonstrations in ``taught``."""

    @property
    def vocabulary(self) -> Vocabulary:
        """The words that it knows."""
        assert self.world.vocabulary is not None
        return self.world.vocabulary

    @cached_property
    def sentences(self) -> list[str]:
        """The instructions of the pool as text."""
        return self.vocabulary.decode(self.pool)

    @cached_property
    def _env(self) -> EnvBase:
        return self.world.instructed(1, seed=0, stream=STREAM)

    @cached_property
    def taught(self) -> World:
        """The world in which a person shows something: of the grid, with any sentences."""
        return OpenGrid() if self.arranges else self.world

    @property
    def arranges(self) -> bool:
        """Whether its world is the library's own grid, which a person can arrange."""
        return isinstance(self._env, PickAndPlaceEnv)

    def read(self, sentence: str) -> Tensor:
        """Return the tokens of a sentence, int64 [1, L].

        Raises:
            UserError: where it is too long, empty, or has unknown words, which are named.
        """
        if len(sentence) > CHARACTERS:
            raise UserError(f"a sentence of {len(sentence):,} characters: {CHARACTERS} are allowed")
        known = set(self.vocabulary.words)
        words = words_of(sentence, self.vocabulary.punctuation)
        if unknown := list(dict.fromkeys(word for word in words if word not in known)):
            raise UserError(f"the policy has never heard {', '.join(map(repr, unknown))}")
        return self.vocabulary.encode([sentence])

    def complete(self, sentence: str, frame: Tensor, count: int = 8) -> list[str]:
        """Return instructions of the pool that hold all words of what was typed so far.

        Those come first that suit the scene best, by the instruction classifier.

        Args:
            sentence: the beginning of one; its last word may be unfinished.
            frame: first frame of the scene, uint8 [C, H, W].
            count: most instructions.
        """
        *whole, last = words_of(sentence[:CHARACTERS]) or [""]
        found = [
            number
            for number, text in enumerate(self.sentences)
            if set(whole) <= set(text.split()) and any(w.startswith(last) for w in text.split())
        ]
        found = found[:: 1 + len(found) // SHOWN]
        if found and self.instruction is not None:
            scores = self._asked(self.instruction, self.pool[found], frame)
            found = [found[place] for place in scores.argsort(descending=True, stable=True)]
        return [self.sentences[number] for number in found[:count]]

    def suits(
        self, sentence: str, frame: Tensor, scene: int, seed: int, state: WorldState | None = None
    ) -> Suited:
        """Say how well a sentence suits a scene.

        Args:
            sentence: any whose words it knows.
            frame: first frame of the scene, uint8 [C, H, W].
            scene: its number.
            seed: of the scenes.
            state: how a person arranged it.

        Raises:
            UserError: where words are unknown.
        """
        tokens, probability, truth = self.read(sentence), None, None
        if self.instruction is not None:
            probability = float(self._asked(self.instruction, tokens, frame))
        if self.world.oracle is not None and self._judges(tokens):
            how: dict[str, Any] = {"seed": seed, "stream": STREAM, "state": state}
            truth = REASONS[self.world.oracle.suits(tokens, scene, **how)]
        return Suited(probability, truth)

    def play(
        self, scene: int, seed: int, sentence: str | None = None, state: WorldState | None = None
    ) -> dict[str, Played]:
        """Let every policy play a scene from its beginning.

        Args:
            scene: its number.
            seed: of the scenes.
            sentence: what is asked; by default the scene's own instruction.
            state: how a person arranged it.

        Raises:
            UserError: where words are unknown, or the world cannot be arranged.
        """
        return {
            name: self._play(policy, scene, seed, sentence, state)
            for name, policy in self.policies.items()
        }

    def _play(
        self,
        policy: nn.Module,
        scene: int,
        seed: int,
        sentence: str | None,
        state: WorldState | None,
    ) -> Played:
        how: dict[str, Any] = {"seed": seed, "stream": STREAM, "state": state}
        how["max_steps"] = MOST_STEPS
        if sentence is None and not self.world.rewarded:
            sentence = self.sentences[0]
        tokens = None if sentence is None else self.read(sentence)
        rewarded = self.world.rewarded and (tokens is None or self._judges(tokens))
        with TURNS:
            if rewarded:
                (episode,) = record_episodes(policy, self._env, [scene], sentence=sentence, **how)
            else:  # it is said to the policy alone
                assert tokens is not None
                (episode,) = record_episodes(told(policy, tokens), self._env, [scene], **how)
                episode = replace(episode, sentence=self.vocabulary.decode(tokens)[0])
            states = self._retrace(scene, episode.actions, state)
            networks = {} if self.goal is None else {"goal": self.goal}
            trace = trace_episode(policy, episode, networks, vocabulary=self.vocabulary)
        tokens = self.vocabulary.encode([episode.sentence])
        frames = torch.from_numpy(episode.frames)
        fulfilled = None
        if self.goal is not None:
            fulfilled = float(self._asked(self.goal, tokens, frames[-1], frames[0]))
        values: list[float] = []
        if self.value is not None:
            with evaluating(self.value):
                words = tokens.expand(len(frames) - 1, -1)
                seen = TensorDict({keys.PIXELS: frames[:-1], keys.INSTRUCTION: words}, [len(words)])
                values = self.value(seen)[keys.STATE_VALUE].flatten().tolist()
        return Played(trace, states, values, fulfilled, episode.success if rewarded else None)

    def _judges(self, tokens: Tensor) -> bool:
        """Whether the world knows what fulfils a sentence of a person's own."""
        if not self.arranges:
            return False
        try:
            grammar(self._env.task).parse_tokens(tokens)
        except UserError:
            return False
        return True

    def _retrace(self, scene: int, actions: Any, state: WorldState | None) -> list[WorldState]:
        """Return the worlds of an episode, for drawing: the policy's actions tell them all."""
        if not self.arranges:
            return []
        if state is None:
            begin(self._env, torch.tensor([scene]))
            state = self._env.truth.state.clone()
        return list(accumulate(torch.as_tensor(actions).unsqueeze(-1), step, initial=state))

    def _asked(
        self, network: Any, tokens: Tensor, frame: Tensor, first: Tensor | None = None
    ) -> Tensor:
        """Return the probability that a classifier gives sentences [N, L] at a frame, [N]."""
        shown = {keys.PIXELS: frame, keys.INITIAL_PIXELS: frame if first is None else first}
        seen = TensorDict(shown).expand(len(tokens)).set(keys.INSTRUCTION, tokens)
        with evaluating(network):
            written = output_key(network, keys.SUITABILITY, keys.GOAL_SCORE)
            return network(seen.select(*network.in_keys))[written].sigmoid().flatten()


def told(policy: Any, tokens: Tensor) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return a policy that hears a sentence, int64 [1, L], whatever the world says."""

    def act(seen: TensorDictBase) -> TensorDictBase:
        said = tokens.expand(*seen.batch_size, -1).clone()
        return policy(seen.copy().set(keys.INSTRUCTION, said))

    return act
