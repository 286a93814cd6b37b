"""navix: MiniGrid in JAX, an empty room of 6x6 cells, with and without pictures."""

import jax
import jax.numpy as jnp
import navix as nx
from serving import serve

STEPS = {"step": 200, "pixels": 20}
BATCH = {"step": 4096, "pixels": 1024}


def rollout(kind: str):
    observe = nx.observations.rgb if kind == "pixels" else nx.observations.none
    env = nx.make("Navix-Empty-6x6-v0", observation_fn=observe)
    batch, steps = BATCH[kind], STEPS[kind]

    @jax.jit
    def start(key):
        return jax.vmap(env.reset)(jax.random.split(key, batch))

    # One call per step, whose pictures are returned: within a scan nobody could look at them.
    @jax.jit
    def step(timestep, action):
        return jax.vmap(env.step)(timestep, action)

    @jax.jit
    def scan(timestep, actions):
        def body(carried, action):
            return step(carried, action), ()

        return jax.lax.scan(body, timestep, actions)[0]

    timestep = start(jax.random.PRNGKey(0))
    actions = jax.random.randint(jax.random.PRNGKey(1), (steps, batch), 0, 7)

    def work() -> float:
        if kind == "step":
            jax.block_until_ready(scan(timestep, actions).reward)
        else:
            present = timestep
            for row in actions:
                present = step(present, row)
                jax.block_until_ready(present.observation)
        return float(steps * batch)

    return work


if __name__ == "__main__":
    jnp.zeros(1)
    serve({kind: rollout(kind) for kind in STEPS})
