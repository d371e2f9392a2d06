"""The scenes of ``contact_scenes.py`` in MuJoCo's flex."""

from __future__ import annotations

import time

import contact_scenes as scenes
import mujoco
import numpy as np

import warp_corot as wc

NAME = f"MuJoCo {mujoco.__version__}, flex, 1 ms"
#: Radius of its nodes, with which they touch [m]; its step [s].
SKIN, STEP = 5e-4, 1e-3

XML = """
<mujoco>
  <size memory="200M"/>
  <option timestep="{dt}" integrator="discrete" gravity="0 0 -{gravity}"/>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 1" friction="{friction}"/>
    {plates}
    {cubes}
  </worldbody>
</mujoco>"""
#: A plate is heavy, and its place and velocity are set before each step: mocap bodies have no velocity for friction.
PLATE = """<body gravcomp="1">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>
      <geom type="box" size="{half}" friction="{friction}" mass="1000"/>
    </body>"""
CUBE = """<flexcomp name="c{k}" type="direct" dim="3" mass="1" radius="{skin}" point="{points}" element="{tets}">
      <contact selfcollide="none" condim="3" friction="{friction}"/>
      <edge equality="false"/>
      <elasticity young="{young}" poisson="{poisson}" damping="{damping}"/>
    </flexcomp>"""


def outcome(scene: scenes.Scene) -> scenes.Outcome:
    """Run it."""
    model = mujoco.MjModel.from_xml_string(_text(scene))
    start = 0
    for mesh in scene.meshes:
        masses = wc.SoftBody(mesh, wc.Isotropic(scene.young, scenes.POISSON, scenes.DENSITY), device="cpu").masses
        model.body_mass[model.flex_vertbodyid[start : start + len(masses)]] = masses
        start += len(masses)
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    ground = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "ground")
    steps, felt, started = 0, [], time.process_time()
    while data.time < scene.ends:
        for k, way in enumerate(scene.ways):
            now, then = (scene.place(way, at) for at in (data.time, data.time + STEP))
            data.qpos[3 * k : 3 * k + 3], data.qvel[3 * k : 3 * k + 3] = now, (then - now) / STEP
        mujoco.mj_step(model, data)
        steps += 1
        if data.time > scene.ends - scene.looked:
            felt.append(_forces(model, data, ground))
    taken = time.process_time() - started
    on_ground, on_plate = np.mean(felt, axis=0)
    counts = np.cumsum([len(mesh.points) for mesh in scene.meshes])[:-1]
    return scenes.Outcome(taken, steps, on_ground, on_plate, np.split(data.flexvert_xpos.copy(), counts), SKIN)


def _text(scene: scenes.Scene) -> str:
    plates = [PLATE.format(half=_joined(np.array(scenes.PLATE)), friction=scenes.FRICTION) for _ in scene.ways]
    cubes = [
        CUBE.format(
            k=k,
            skin=SKIN,
            points=_joined(mesh.points),
            tets=_joined(wc.TetMesh(mesh.points, mesh.tets).tets),
            friction=scenes.FRICTION,
            young=scene.young,
            poisson=scenes.POISSON,
            damping=scenes.VISCOSITY,
        )
        for k, mesh in enumerate(scene.meshes)
    ]
    joined = {"plates": "\n".join(plates), "cubes": "\n".join(cubes)}
    return XML.format(dt=STEP, gravity=scenes.GRAVITY, friction=scenes.FRICTION, **joined)


def _forces(model: mujoco.MjModel, data: mujoco.MjData, ground: int) -> tuple[float, float]:
    """On the ground upwards, and across the first plate [N]."""
    on_ground, on_plate, wrench = 0.0, 0.0, np.zeros(6)
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, wrench)
        force = data.contact[k].frame.reshape(3, 3).T @ wrench[:3]
        if ground in data.contact[k].geom:
            on_ground += force[2]
        elif ground + 1 in data.contact[k].geom:
            on_plate += force[1]
    return abs(on_ground), abs(on_plate)


def _joined(values: np.ndarray) -> str:
    return " ".join(map(repr, values.ravel().tolist()))
