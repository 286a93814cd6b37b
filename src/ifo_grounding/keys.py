"""Every tensordict key and every constant of the interface, named once."""

from __future__ import annotations

PIXELS = "pixels"
"""Image of the world, uint8 [*B, 3, H, W]."""
INSTRUCTION = "instruction"
"""Token ids of the instruction, int64 [*B, 16]; 0 pads."""
ACTION = "action"
"""Index into :data:`ACTIONS`, int64 [*B]."""
NEXT = "next"
"""Prefix of what a step leads to."""
NEXT_PIXELS = (NEXT, PIXELS)
"""Image that a step leads to, uint8 [*B, 3, H, W]."""
REWARD = "reward"
"""True success at the end of an episode, float32 [*B, 1]. For evaluation only."""
LEARNED_REWARD = "learned_reward"
"""Reward from a learned model, float32 [*B, 1]."""
LOGITS = "logits"
"""Unnormalised log-probabilities of the actions, float32 [*B, A]."""
SUITABILITY = "suitability"
"""Logit that an instruction suits a state, float32 [*B, 1]."""
ACTION_SCORE = "action_score"
"""Logit that an action is right for a state and an instruction, float32 [*B, 1]."""
GOAL_SCORE = "goal_score"
"""Logit that an instruction is fulfilled, float32 [*B, 1]."""
INITIAL_PIXELS = "initial_pixels"
"""Image at the start of the episode, uint8 [*B, 3, H, W]."""
STATE_VALUE = "state_value"
"""Expected learned return, float32 [*B, 1]."""
FINAL = "final"
"""Whether a frame is the last of its demonstration, bool [*B, 1]."""
SCENE = "scene"
"""Number of a scene in a simulator's stream, int64 [*B, 1]."""

ACTIONS = ("U", "R", "D", "L", "P", "S")
"""Up, right, down, left, pick or place, stop: the paper's order."""
N_ACTIONS = len(ACTIONS)
STOP = ACTIONS.index("S")
INSTRUCTION_LENGTH = 16
"""Tokens per instruction, padding included."""
