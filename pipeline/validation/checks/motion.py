"""Checks of actions, states, the gripper and the marks of steps."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.catalogue.scene_files import portable
from pipeline.episode_schema import MOTION, SCHEMA
from pipeline.formats.read_back import Copy, Fault
from pipeline.validation.case import Case, same_bits

ARM = slice(1, 8)
"""Joint angles in a flattened state, after the time: LIBERO's robot comes first in every scene."""

GRIP_IN_HAND = Rotation.from_euler("z", -90, degrees=True)
"""Orientation of the grip site, which the controller moves, in the hand, whose orientation the state has."""

GOAL_TOLERANCE = 1e-5
"""Largest difference of goals in m and rad; state and goal are rounded to float32."""

RESPONSE_STEPS = 8
"""Number of steps (0.4 s) in which the fingers respond to a change of the command.

At other times contacts may move them against it: the stove's knob opened closed fingers, and closed open ones, by 0.075
m in all."""

AGAINST_M = 0.01
"""Sum of the distances that the fingers may move against the command in ``RESPONSE_STEPS`` after its changes.

In each of 1,500 episodes with changes they moved 0.005 m or more with it, and 0.02 m or more in 99 % of them."""


def check_length(case: Case) -> Iterator[Fault]:
    """Check that every place has as many steps as the replay executed."""
    steps = len(case.trajectory.actions)
    places = [("manifest", case.row["steps"]), ("frames", len(case.episode))]
    places += [(copy.dataset, len(copy)) for copy in case.copies]
    for dataset, number in places:
        if number != steps:
            yield case.finding(dataset, f"has {number} steps", steps)


def check_motion(case: Case) -> Iterator[Fault]:
    """Check actions, states and joint angles, bit for bit; actions and joint angles must be the replay's."""
    replay = case.trajectory
    if not same_bits(case.episode.joint_state, replay.states[:-1, ARM].astype(np.float32)):
        yield case.finding("frames", "has other joint angles", "the joint angles of the replay")
    if not same_bits(case.episode.action, replay.actions.astype(np.float32)):
        yield case.finding("frames", "has other actions", "the actions of the replay")
    else:
        yield from _compare_goals(case)
    for copy in case.copies:
        # Copies of another length cannot be compared; ``length`` reports them.
        for name in MOTION if len(copy) == len(case.episode) else ():
            values, stored = getattr(copy.episode, name), getattr(case.episode, name)
            if (values.shape, values.dtype) != (stored.shape, stored.dtype):
                what, expected = f"{values.shape} of {values.dtype}", f"{stored.shape} of {stored.dtype}"
                yield case.finding(copy.dataset, f"{name} is {what}", expected)
            elif not same_bits(values, stored):
                step = next(t for t in range(len(stored)) if not same_bits(values[t], stored[t]))
                what = f"{name} of step {step} is {values[step].tolist()}"
                yield case.finding(copy.dataset, what, stored[step].tolist())
        yield from _compare_replay(case, copy)


def _compare_replay(case: Case, copy: Copy) -> Iterator[Fault]:
    """Compare the states and the scene that a dataset stores with the replay's, bit for bit."""
    stored, trajectory = copy.episode.replay, case.trajectory
    if stored is None:
        return
    if not same_bits(stored.actions, trajectory.actions):
        yield case.finding(copy.dataset, "has other actions in double precision", "the actions of the replay")
    if not same_bits(stored.states, trajectory.states[:-1]):
        yield case.finding(copy.dataset, "has other states", "the states of the replay before each action")
    scene, expected = stored.scene, trajectory.scene
    if scene.model_xml != portable(expected.model_xml):
        yield case.finding(copy.dataset, "has another scene in model_file", "the scene of the replay")
    if not same_bits(scene.state, expected.state) or scene.start != expected.start:
        yield case.finding(copy.dataset, "has another start", "the start of the replay")
    if stored.origin_sha256 != case.row["demo_origin_sha256"]:
        yield case.finding(copy.dataset, f"origin_sha256 is {stored.origin_sha256}", case.row["demo_origin_sha256"])


def _compare_goals(case: Case) -> Iterator[Fault]:
    """Compare the absolute actions with state and delta of their step.

    The goal of the orientation is compared at steps that turn the hand; at others, it is a former goal.
    """
    episode, spec = case.episode, SCHEMA.action
    deltas = np.clip(episode.action[:, :6].astype(float), *spec.range) * spec.units
    goals = episode.action_absolute.astype(float)
    positions_m = episode.state[:, :3] + deltas[:, :3]
    turns = np.any(deltas[:, 3:] != 0, axis=1)
    hands = Rotation.from_rotvec(episode.state[:, 3:6]) * GRIP_IN_HAND
    apart = Rotation.from_rotvec(goals[:, 3:6]).inv() * Rotation.from_rotvec(deltas[:, 3:]) * hands
    if np.abs(goals[:, :3] - positions_m).max() > GOAL_TOLERANCE:
        yield case.finding("frames", "action_absolute has other positions", "state plus delta")
    if np.any(apart.magnitude()[turns] > GOAL_TOLERANCE):
        yield case.finding("frames", "action_absolute has other orientations", "state turned by delta")
    if not same_bits(episode.action_absolute[:, 6], episode.action[:, 6]):
        yield case.finding("frames", "action_absolute has other gripper commands", "those of action")


def check_gripper(case: Case) -> Iterator[Fault]:
    """Check that commands are -1 or +1, and that the fingers open and close accordingly."""
    commands = SCHEMA.action.gripper
    for copy in case.comparable_copies:
        command, state = copy.episode.action[:, 6], copy.episode.state
        strange = commands.others(command)
        if strange:
            yield case.finding(copy.dataset, f"gripper command {min(strange)}", f"{commands.open} or {commands.close}")
        gap_m = state[:, 6] - state[:, 7]
        moved_m = np.sign(command[:-1] * commands.open) * np.diff(gap_m)
        responding = np.zeros(len(moved_m), bool)
        for step in np.flatnonzero(np.diff(command)) + 1:
            responding[step : step + RESPONSE_STEPS] = True
        with_command_m = float(moved_m[responding].sum())
        if with_command_m < -AGAINST_M:
            what = f"fingers move {-with_command_m:.3f} m against changes of the gripper's command"
            yield case.finding(copy.dataset, what, f"{commands.open} opens, {commands.close} closes")


def check_flags(case: Case) -> Iterator[Fault]:
    """Check the marks of the first and last step, of success, and the reward, which only a success's last step has.

    Marks that a dataset does not have are skipped.
    """
    for copy in case.copies:
        step = np.arange(len(copy))
        last = step == len(step) - 1
        marks = {"is_first": step == 0, "is_last": last, "discount": step >= 0}
        marks |= dict.fromkeys(("is_terminal", "reward"), last & case.row["kept"])
        marks["is_success"] = np.full(len(step), case.row["kept"])
        yield from _compare_marks(case, copy, marks)


def check_clock(case: Case) -> Iterator[Fault]:
    """Check that physics steps and timestamps keep the frame rate, and that frames are counted from 0.

    Timestamps and frame numbers are skipped if a dataset does not have them.
    """
    taken = np.diff(case.trajectory.states[:, 0])
    if not np.allclose(taken, 1 / SCHEMA.fps_hz, rtol=0, atol=1e-6):
        yield case.finding("frames", f"steps take {taken.min():g} to {taken.max():g} s", f"{1 / SCHEMA.fps_hz:g} s")
    for copy in case.copies:
        step = np.arange(len(copy))
        yield from _compare_marks(case, copy, {"frame_index": step, "timestamp": step / SCHEMA.fps_hz})


def _compare_marks(case: Case, copy: Copy, wanted: Mapping[str, NDArray[Any]]) -> Iterator[Fault]:
    for name in sorted(copy.step_marks.keys() & wanted.keys()):
        values, expected = copy.step_marks[name], wanted[name]
        for step in np.flatnonzero(~np.isclose(values, expected, rtol=0, atol=1e-4))[:1]:
            what = f"{name} of step {step} is {float(values[step]):g}"
            yield case.finding(copy.dataset, what, f"{float(expected[step]):g}")
