"""Environments in which a policy learns to handle soft tissue, as vector environments of gymnasium.

``import warp_corot.envs`` registers them: ``gymnasium.make_vec("warp_corot/Retract-v0", num_envs=64)``.
"""

from __future__ import annotations

from functools import partial

from gymnasium import register

from .blocks import Lift, Stack
from .cut import Cut
from .franka import FrankaLift
from .single import SingleEnv
from .soft_env import RATE, SoftEnv
from .task import Scene, Task
from .tissue import Palpate, Reach, Retract, Thread

__all__ = ["RATE", "TASKS", "Cut", "FrankaLift", "Lift", "Palpate", "Reach", "Retract", "Scene", "SingleEnv"]
__all__ += ["SoftEnv", "Stack", "Task", "Thread"]

#: The environments of several worlds by their names in gymnasium.
TASKS = {f"warp_corot/{kind.__name__}-v0": kind for kind in (Retract, Palpate, Reach, Lift, Thread, Stack, FrankaLift)}

for _name, _kind in TASKS.items():
    register(_name, entry_point=partial(SingleEnv, _kind), vector_entry_point=_kind)
register("warp_corot/Cut-v0", entry_point=Cut)
