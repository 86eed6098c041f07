"""Scripted policies that repeat a demonstration of a task, to check an evaluation."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.evaluation.policies import Look, Wanted
from pipeline.evaluation.recordings import demonstration
from pipeline.evaluation.simulator import Simulator
from pipeline.evaluation.tasks import EvaluationTask
from pipeline.libero.starts import kept_actions, recorded_start
from pipeline.libero.tasks import find_task
from pipeline.physics.environment import DUMMY_ACTION
from pipeline.physics.reference import Reference
from pipeline.physics.tracking import Hand, Route, follow
from pipeline.types import Demo, Floats


class Replay:
    """Policy that repeats the demonstration's actions open-loop and without no-ops, and then rests.

    Args:
        chunk: number of actions per answer.
        demos: folder of the demonstrations; by default the starter set.
    """

    name = "replay"
    wanted = Wanted(wrist=False, state=False, images=False)

    def __init__(self, chunk: int = 8, demos: Path | None = None):
        self._chunk, self._demos = chunk, demos

    def begin(self, task: EvaluationTask) -> None:
        """Begin with the first action of the task's demonstration."""
        recorded = demonstration(find_task(task.suite, task.base), task.number, self._demos).actions
        self._actions, self._taken = recorded[kept_actions(recorded, "drop")], 0

    def act(self, look: Look) -> Floats:
        """Return the next chunk of actions, (n, 7), or no-ops at the end of the demonstration."""
        actions = self._actions[self._taken : self._taken + self._chunk]
        self._taken += self._chunk
        return actions if len(actions) else np.tile(DUMMY_ACTION, (self._chunk, 1))

    def end(self, success: bool) -> None:
        """End the episode, without effect on the policy."""


class TrackedReplay:
    """Policy that follows the hand's path of the demonstration by feedback, one action at a time.

    The control law is that of the tracked replay that generates datasets (``pipeline.physics.tracking``). The policy
    knows the end effector's pose from observations, but not the poses of objects. Therefore it follows the
    demonstration's path from any start of the arm.

    Args:
        demos: folder of the demonstrations; by default the starter set.
    """

    name = "tracked replay"
    wanted = Wanted(wrist=False, images=False)

    def __init__(self, demos: Path | None = None):
        self._demos = demos

    def begin(self, task: EvaluationTask) -> None:
        """Begin with the task's demonstration as the reference."""
        self._reference = _reference(demonstration(find_task(task.suite, task.base), task.number, self._demos))
        self._actions: Iterator[Floats] | None = None

    def act(self, look: Look) -> Floats:
        """Return the next action (7,) from the end effector's pose in a new observation."""
        position, axis_angle, _ = np.split(look(self.wanted)["states"].astype(np.float64), (3, 6))
        self._hand: Hand = position, Rotation.from_rotvec(axis_angle)
        if self._actions is None:
            route = Route.through(self._reference, self._hand, {})
            # The hand holds no object in this reference, so ``follow`` asks for no object's pose.
            self._actions = follow(route, lambda: self._hand, lambda _: np.zeros(7))
        # At the end of the path the hand rests, and the gripper keeps the demonstration's last command.
        return next(self._actions, np.append(np.zeros(6), self._reference.actions[-1, 6]))

    def end(self, success: bool) -> None:
        """End the episode, without effect on the policy."""


_references: dict[str, Reference] = {}
"""SHA-256 of the last demonstration to its reference."""


def _reference(demo: Demo) -> Reference:
    """Return a demonstration as observations show it, replayed open-loop from its own first state."""
    if demo.sha256 not in _references:
        _references.clear()
        _references[demo.sha256] = _replayed(demo)
    return _references[demo.sha256]


def _replayed(demo: Demo) -> Reference:
    """Replay a demonstration open-loop, and return its observations as a reference."""
    actions = demo.actions[kept_actions(demo.actions, "drop")]
    with closing(Simulator(demo.task)) as simulator:
        scene = recorded_start(demo, demo.model_xml or simulator.place_fixtures(0))
        simulator.start_scene(scene)
        states, observed = [simulator.state], [simulator.observed.state]
        for action in actions:
            simulator.step(action)
            states.append(simulator.state)
            observed.append(simulator.observed.state)
    position_m, axis_angle, _ = np.split(np.stack(observed).astype(np.float64), (3, 6), axis=1)
    return replace(
        Reference.of(scene.model_xml, np.stack(states), actions),
        positions_m=position_m,
        rotations=Rotation.from_rotvec(axis_angle),
        held={},
        carried={},
    )
