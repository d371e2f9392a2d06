"""MuJoCo's flex on the problem's mesh, on one CPU core. The import fails if MuJoCo is not installed.

Its solid elasticity is St. Venant-Kirchhoff on edges, like ``EdgeStVK``; contacts and edge equalities are off.
"""

from __future__ import annotations

import mujoco
import numpy as np
from problem import MATERIAL, Problem, relative_error
from stable import Steppable

import warp_corot as wc

NAME = f"MuJoCo {mujoco.__version__}"

#: Largest number of tetrahedra: MuJoCo reads its model from a text and steps on one core.
MOST_TETS = 50_000

# It would write warnings to a file in the current folder; a diverged state is detected below.
mujoco.set_mju_user_warning(lambda message: None)

XML = """
<mujoco>
  <option timestep="1e-5" integrator="{integrator}" gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <flexcomp name="body" type="direct" dim="3" mass="1" radius="0.0001" point="{points}" element="{tets}">
      <contact selfcollide="none"/>
      <edge equality="false"/>
      <pin id="{held}"/>
      <elasticity young="{young}" poisson="{poisson}" damping="0"/>
    </flexcomp>
  </worldbody>
</mujoco>"""


def _joined(values: np.ndarray) -> str:
    return " ".join(map(repr, values.ravel().tolist()))


class MujocoSteps(Steppable):
    """``mj_step`` from the problem's state; pinned nodes, which MuJoCo cannot displace, start at rest."""

    def __init__(self, problem: Problem):
        self.name = f"{NAME}, flex, Euler (one CPU core)"
        self.problem = problem
        mesh = problem.mesh
        text = XML.format(
            integrator="Euler",
            points=_joined(mesh.points),
            tets=_joined(wc.TetMesh(mesh.points, mesh.tets).tets),
            held=_joined(np.flatnonzero(problem.held)),
            young=MATERIAL["young"],
            poisson=MATERIAL["poisson"],
        )
        self.model = mujoco.MjModel.from_xml_string(text)
        bodies = self.model.flex_vertbodyid[~problem.held]
        self.model.body_mass[bodies] = problem.body.masses[~problem.held]
        self.data = mujoco.MjData(self.model)
        mujoco.mj_setConst(self.model, self.data)
        self.dofs = self.model.body_dofadr[bodies][:, None] + np.arange(3)
        self.dt = 0.0

    def reset(self) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self.dofs] = self.problem.u[~self.problem.held]

    def step(self, count: int) -> None:
        self.model.opt.timestep = self.dt
        for _ in range(count):
            mujoco.mj_step(self.model, self.data)

    def largest_displacement(self) -> float:
        # MuJoCo resets a diverged state to the initial one, and counts that.
        kinds = mujoco.mjtWarning
        kinds = (kinds.mjWARN_BADQACC, kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL)
        blown_up = any(self.data.warning[kind].number for kind in kinds)
        return float("inf") if blown_up else float(np.abs(self.data.qpos).max())

    def error(self) -> float:
        """Error of the elastic forces."""
        problem = self.problem
        self.reset()
        mujoco.mj_forward(self.model, self.data)
        found = np.zeros((problem.node_count, 3))
        found[~problem.held] = self.data.qfrc_passive[self.dofs]
        x = np.where(problem.held[:, None], problem.mesh.points, problem.x)
        free = ~problem.held[problem.sample.nodes]
        reference = problem.sample.forces("edge_stvk", x, problem.mu, problem.lam)
        return relative_error(found[problem.sample.nodes][free], reference[free])


def steps(problem: Problem) -> list[Steppable]:
    return [MujocoSteps(problem)]
