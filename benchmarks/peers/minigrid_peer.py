"""MiniGrid: an empty room of 6x6 cells as pictures of 48x48 pixels, alone and as a vector env."""

import gymnasium
from minigrid.wrappers import ImgObsWrapper, RGBImgObsWrapper
from serving import serve

STEPS = 300
VECTOR = 64


def make():
    return ImgObsWrapper(RGBImgObsWrapper(gymnasium.make("MiniGrid-Empty-6x6-v0"), tile_size=8))


def pixels() -> float:
    for _ in range(STEPS):
        _, _, terminated, truncated, _ = single.step(single.action_space.sample())
        if terminated or truncated:
            single.reset()
    return STEPS


def vector() -> float:
    for _ in range(4):
        many.step(many.action_space.sample())
    return 4 * VECTOR


if __name__ == "__main__":
    single = make()
    single.reset(seed=0)
    many = gymnasium.vector.SyncVectorEnv([make] * VECTOR)
    many.reset(seed=0)
    serve({"pixels": pixels, "vector": vector})
