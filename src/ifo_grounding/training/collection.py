"""Where the steps of self-examination are collected: in this process, or by workers of Ray."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.cluster import connect, environment
from ifo_grounding.errors import UserError
from ifo_grounding.modules import device_of
from ifo_grounding.seeding import derive
from ifo_grounding.training.loop import Metrics
from ifo_grounding.training.reseeding import reseed, sampler_stats, transforms_of

LEFT_OUT = (keys.REWARD, (keys.NEXT, keys.REWARD))
"""The simulator's own reward, which no learner sees."""
FIRST = (keys.INITIAL_PIXELS, (keys.NEXT, keys.INITIAL_PIXELS))
"""What the goal reward carries along, which no update reads."""
PATIENCE = 60.0
"""Seconds in which a cluster has to find room for all workers."""
TRIES = 3
"""How often workers begin to collect the same steps."""


class Here:
    """Collects in this process."""

    def __init__(self, env: EnvBase, policy: nn.Module, steps: int) -> None:
        self.env = env
        self.collector = Collector(  # on a CPU a round is written over the one before
            env,
            policy,
            frames_per_batch=env.batch_size.numel() * steps,
            total_frames=-1,
            return_same_td=env.device is not None and env.device.type == "cpu",
            reset_at_each_iter=True,
            trust_policy=True,
            track_traj_ids=False,  # which would wait for a GPU at every step
            auto_register_policy_transforms=False,
        )
        self.batches = iter(self.collector)
        sampler_stats(env)  # forgets the reset that a collector begins with

    def collect(self, seed: int) -> tuple[TensorDictBase, Metrics]:
        """Roll out the policy from a reset, [N, T], and tell what the transforms counted."""
        reseed(self.env, seed)
        batch = next(self.batches).exclude(*LEFT_OUT)
        return batch, sampler_stats(self.env)

    def close(self) -> None:
        """End, but leave the env to its owner."""
        self.collector.shutdown(close_env=False)


class Worker(Collector):
    """A collector in a process of Ray's, which keeps nothing from one round to the next."""

    def collect(self, weights: list[Tensor], seed: int) -> tuple[TensorDictBase, Tensor, Metrics]:
        """Roll out with these weights from a reset, and return what :func:`_joined` reads.

        That is steps [N, T], the images that no next step begins with, and what was counted.
        """
        with torch.no_grad():
            for mine, sent in zip(_weights(self.policy, self.env), weights, strict=True):
                mine.copy_(sent)
        reseed(self.env, seed)
        batch = self.next()
        return (
            batch.exclude(*LEFT_OUT, *FIRST, keys.NEXT_PIXELS),
            batch[keys.NEXT_PIXELS][ends(batch)],
            sampler_stats(self.env),
        )


class OnRay:
    """Collects by workers of TorchRL's ``RayCollector``, each with an environment of its own.

    With each request they are sent the weights of the policy and of the networks in transforms.
    Where one of them dies, all begin anew and collect the same steps.

    Args:
        env: with the networks whose weights are sent.
        make_envs: each makes the environment of a worker, on a CPU, like ``env`` but for its rows.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: nn.Module,
        steps: int,
        make_envs: Sequence[Callable[[], EnvBase]],
    ) -> None:
        self.ray = connect()
        self.env, self.policy, self.make_envs = env, policy, list(make_envs)
        self.frames = env.batch_size.numel() * steps
        self.workers: Any = None
        self.group: Any = None

    def collect(self, seed: int) -> tuple[TensorDictBase, Metrics]:
        """Roll out the policy from resets, [N, T], and tell what the transforms counted.

        Raises:
            UserError: where the cluster has too few free processors, or workers die again and
                again; and what a worker raises.
        """
        said = ""
        for _ in range(TRIES):
            try:
                batches, last, counted = zip(*self._ask(seed), strict=True)
            except self.ray.exceptions.RayTaskError as error:
                raise error.cause from None
            except self.ray.exceptions.RayError as error:  # a process or a machine died
                said = str(error).strip().splitlines()[-1]
                self.close()
            else:
                torch.manual_seed(seed)
                batch = _joined(batches, last)
                return batch.to(device_of(self.policy) or "cpu"), _total(counted)
        raise UserError(f"Ray workers died {TRIES} times: {said}; run the same again to go on")

    def _ask(self, seed: int) -> list[tuple[TensorDictBase, Tensor, Metrics]]:
        """Let every worker collect its rows."""
        if self.workers is None:
            self._start()
        weights = self.ray.put([each.detach().cpu() for each in _weights(self.policy, self.env)])
        seeds = [derive(seed, "worker", number) for number in range(len(self.make_envs))]
        return self.workers.map_fn("collect", [(weights, each) for each in seeds])

    def _start(self) -> None:
        """Start the workers, all of them at once or none."""
        from ray.util.placement_group import placement_group
        from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy
        from torchrl.collectors.distributed import RayCollector

        count = len(self.make_envs)
        self.group = placement_group([{"CPU": 1}] * count, strategy="SPREAD")
        if not self.group.wait(PATIENCE):
            there = self.ray.cluster_resources().get("CPU", 0)
            self.close()
            raise UserError(
                f"{count} collectors need a free processor each, of {there:g} in the Ray cluster: "
                "add machines or wait for other jobs, and run the same again to go on"
            )
        self.workers = RayCollector(
            self.make_envs,
            copy.deepcopy(self.policy).to("cpu"),
            frames_per_batch=self.frames,
            total_frames=-1,
            sync=True,
            collector_class=Worker,
            collector_kwargs=[
                {"auto_register_policy_transforms": False, "track_traj_ids": False}
                for _ in range(count)
            ],
            reset_at_each_iter=True,
            trust_policy=True,
            remote_configs={
                "num_cpus": 1,
                "scheduling_strategy": PlacementGroupSchedulingStrategy(self.group),
                "runtime_env": environment(),
            },
            weight_sync_schemes={},  # weights come with each request
        )

    def close(self) -> None:
        """End the workers."""
        from ray.util import remove_placement_group

        if self.workers is not None:
            self.workers.shutdown()
        if self.group is not None:
            remove_placement_group(self.group)
        self.workers = self.group = None


def ends(batch: TensorDictBase) -> Tensor:
    """Return the steps [N, T] that another one of the row does not go on from, bool."""
    ends = batch[keys.NEXT, "done"].reshape(batch.shape).clone()
    ends[:, -1] = True
    return ends


def _joined(batches: Sequence[TensorDictBase], last: Sequence[Tensor]) -> TensorDictBase:
    """Return the steps of all workers, with the image after each: mostly the next step's."""
    batch: TensorDictBase = torch.cat(list(batches))
    after = batch[keys.PIXELS].roll(-1, 1)
    after[ends(batch)] = torch.cat(list(last))
    return batch.set(keys.NEXT_PIXELS, after)


def _weights(policy: nn.Module, env: EnvBase) -> list[Tensor]:
    """Return the weights of a policy and of all networks in the transforms around an env."""
    modules = [policy, *transforms_of(env)]
    return [tensor for each in modules for tensor in (*each.parameters(), *each.buffers())]


def _total(counted: Sequence[Metrics]) -> Metrics:
    """Return what the transforms of all workers counted: numbers add up, means are weighted."""
    total = {name: sum(each[name] for each in counted) for name in counted[0]}
    weights = {"served_share": "states_drawn", "mean_score": "states_served"}
    for name in weights.keys() & total.keys():
        parts = [each[name] * each[weights[name]] for each in counted]
        total[name] = sum(parts) / max(total[weights[name]], 1)
    return total
