"""A single environment, for programs that take no vector of them."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from .soft_env import SoftEnv
from .task import Actions


class SingleEnv(gymnasium.Env[Actions, Actions]):
    """One world of a ``SoftEnv`` as a ``gymnasium.Env``; ``reset`` begins the next episode.

    Args:
        kind: The class of the environment.
        options: As for ``SoftEnv``, without ``num_envs``, ``array`` and ``autoreset``.
    """

    def __init__(self, kind: type[SoftEnv], **options: Any):
        self.worlds = kind(1, **options)
        self.observation_space = self.worlds.single_observation_space
        self.action_space = self.worlds.single_action_space
        self.metadata = {name: each for name, each in self.worlds.metadata.items() if name != "autoreset_mode"}
        self.render_mode = self.worlds.render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Actions, dict[str, Any]]:
        super().reset(seed=seed)
        observations, info = self.worlds.reset(seed=seed)
        return observations[0], info

    def step(self, action: Actions) -> tuple[Actions, float, bool, bool, dict[str, Any]]:
        observations, reward, terminated, truncated, info = self.worlds.step(np.asarray(action)[None])
        info = {name: each[0].item() for name, each in info.items()}
        return observations[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> npt.NDArray[np.uint8] | None:
        pictures = self.worlds.render()
        return None if pictures is None else pictures[0]

    def scripted_actions(self, observation: Actions) -> Actions:
        """Actions of the policy by hand."""
        return self.worlds.scripted_actions(observation[None])[0]
