"""Puts recipes/ into the wheel; an editable installation uses those of the checkout instead."""

from __future__ import annotations

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class RecipesHook(BuildHookInterface):
    """Adds ``ifo_grounding/recipes`` to a standard wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called before each build; ``version`` is ``standard`` or ``editable``."""
        if version == "standard":
            build_data["force_include"]["recipes"] = "ifo_grounding/recipes"
