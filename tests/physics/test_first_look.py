"""The first frame of an episode shows what an evaluation of LIBERO shows first: everything at rest, gripper open."""

from contextlib import closing
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from short_demonstrations import BOWL, MILK, STOVE, starter_demo

from pipeline.libero.starts import recorded_start
from pipeline.physics.control_env import seeded
from pipeline.physics.environment import Environment
from pipeline.types import Floats, Task, Trajectory


class Look(NamedTuple):
    """Position (3,) in m and orientation of the hand, its speed, the gripper's width, and the fastest other thing."""

    position_m: Floats
    rotation: Rotation
    speed_m_s: float
    width_m: float
    others_m_s: float


def look(model: mujoco.MjModel, state: Floats) -> Look:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state[1 : 1 + model.nq], state[1 + model.nq :]
    mujoco.mj_forward(model, data)
    moving = np.zeros(6)
    site = model.site("gripper0_grip_site").id
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site, moving, 0)
    free = [joint for joint in range(model.njnt) if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE]
    speeds = [np.linalg.norm(data.qvel[model.jnt_dofadr[joint] :][:3]) for joint in free]
    return Look(
        data.site(site).xpos.copy(),
        Rotation.from_matrix(data.site(site).xmat.reshape(3, 3)),
        float(np.linalg.norm(moving[3:])),
        float(data.joint("gripper0_finger_joint1").qpos[0] - data.joint("gripper0_finger_joint2").qpos[0]),
        float(max(speeds)),
    )


@pytest.fixture(params=[STOVE, BOWL, MILK], ids=lambda task: task.name)
def task(request: pytest.FixtureRequest) -> Task:
    chosen: Task = request.param
    return chosen


def test_an_episode_begins_as_an_evaluation_does(task: Task, whole: dict[Task, Trajectory]) -> None:
    """OpenVLA's regeneration: LIBERO's own reset, the recorded state, ten steps of nothing with the gripper open."""
    with closing(Environment(task)) as libero:
        env = libero._env
        with seeded(0):
            env.reset()
        env.set_init_state(starter_demo(task).init_state)
        for _ in range(10):
            env.step([0.0] * 6 + [-1.0])
        theirs = look(env.sim.model._model, libero.state)
    ours = look(mujoco.MjModel.from_xml_string(whole[task].model_xml), whole[task].states[0])
    assert ours.width_m == pytest.approx(theirs.width_m, abs=1e-3)
    assert ours.width_m == pytest.approx(0.0774, abs=1e-3)
    assert np.linalg.norm(ours.position_m - theirs.position_m) < 0.003
    assert np.degrees((ours.rotation * theirs.rotation.inv()).magnitude()) < 0.3
    assert ours.speed_m_s < 0.01
    assert ours.others_m_s < 0.01


def test_the_gripper_stays_open_while_the_action_says_open(task: Task, whole: dict[Task, Trajectory]) -> None:
    """A recording starts five open steps in, so the gripper's command is there already."""
    replayed, model = whole[task], mujoco.MjModel.from_xml_string(whole[task].model_xml)
    closing_at = int(np.flatnonzero(np.append(replayed.actions[:, 6], 1.0) > 0)[0])
    widths_m = [look(model, state).width_m for state in replayed.states[: min(closing_at, 10)]]
    assert (np.diff(widths_m) > -1e-4).all()
    with closing(Environment(task)) as unsettled:
        unsettled.restore(recorded_start(starter_demo(task), replayed.model_xml, settles=False))
        widths_m = [look(model, unsettled.state).width_m]
        for action in starter_demo(task).actions[:5]:
            unsettled.step(action)
            widths_m.append(look(model, unsettled.state).width_m)
    assert (np.diff(widths_m) > 0).all(), "it opens on, as when it was recorded"
