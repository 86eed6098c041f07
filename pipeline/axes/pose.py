"""Pose: where the object that a task moves stands at the start. Physics layer."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import PositiveFloat

from pipeline.axes.base import Axis, Nearest, PhysicsPerturbation, RefusedError
from pipeline.types import Demo, Floats, Scene, Task

if TYPE_CHECKING:
    from pipeline.scene import Compiled
    from pipeline.testset import TestSet

SETTLE_S = 0.3
"""How long a target is watched. The farthest that one of the starter demonstrations still falls takes 0.06 s."""

DEEPER_M = 0.001
"""How much deeper than recorded a moved target may sit in what it touches, such as the wall of its drawer."""

CREEP_M, CREEP_DEG = 0.002, 2.0
"""How much farther than the recorded target a moved one may slide and tilt until it rests."""

NEXT_TO_M = 0.17
"""Distance of centres up to which things stand next to each other; LIBERO has them 0.12 to 0.13 m apart."""

BETWEEN = 0.25
"""Share of the way between two things that still counts as at one of them, and as beside the line between them."""


class PosePerturbation(PhysicsPerturbation):
    """The target moved in the horizontal plane and turned on the spot.

    Attributes:
        target: the object's name in the BDDL file; None when the task moves none.
        dx_m, dy_m: displacement along the world's axes from where the demonstration has it.
        dyaw_deg: counter-clockwise turn about the vertical through its origin.
    """

    axis: Literal["pose"] = "pose"
    component: Literal["target"] = "target"
    target: str | None
    dx_m: float
    dy_m: float
    dyaw_deg: float

    # A quarter of the 2 cm square that LIBERO's own reset scatters an object in.
    clearance: ClassVar[float] = 0.005
    measure: ClassVar[str] = "m: the norm of the difference between the displacements of the same object"

    def apply(self, scene: Scene, demo: Demo) -> Scene:
        """The scene with the target moved; its height and velocity and everything else stay as they are.

        The recorded and the moved target are both watched for ``SETTLE_S`` while everything else is held: they must
        come to rest on the same things, after as little motion.

        Raises:
            RefusedError: ``no_movable_target`` when the task only turns or opens something; ``relation_broken`` when
                the target leaves what it stands on or in, or the place that the instruction names;
                ``target_in_collision`` when it touches something else; ``target_unstable`` when it slides or tilts
                more than the recorded one.
        """
        from pipeline.scene import Compiled

        if self.target is None:
            raise RefusedError("no_movable_target")
        compiled = Compiled(scene)
        then = _settle(compiled, self.target)
        state = scene.state.copy()
        address = 1 + int(compiled.model.joint(f"{self.target}_joint0").qposadr[0])
        pose = state[address : address + 7]
        pose[:] = self._moved(pose)
        compiled.restore(state)
        if not _relation_holds(demo.task, self.target, lambda name: compiled.data.body(f"{name}_main").xpos[:2]):
            raise RefusedError("relation_broken")
        now = _settle(compiled, self.target)

        new = (now.started.keys() | now.rested.keys()) - (then.started.keys() | then.rested.keys())
        deeper = any(gap_m < then.started.get(pair, 0.0) - DEEPER_M for pair, gap_m in now.started.items())
        if new or deeper:
            raise RefusedError("target_in_collision")
        if then.rested.keys() - now.rested.keys():
            raise RefusedError("relation_broken")
        if now.slid_m > then.slid_m + CREEP_M or now.tilted_deg > then.tilted_deg + CREEP_DEG:
            raise RefusedError("target_unstable")
        found = {"target": self.target, "position_m": pose[:3].tolist(), "rotation_wxyz": pose[3:].tolist()}
        return replace(scene, state=state, resolved={**scene.resolved, "pose": found})

    def _moved(self, pose: Floats) -> Floats:
        """A pose (7,) (m, wxyz), moved and turned."""
        half_rad = math.radians(self.dyaw_deg) / 2
        c, s = math.cos(half_rad), math.sin(half_rad)
        x, y, z, qw, qx, qy, qz = pose
        turned = [c * qw - s * qz, c * qx - s * qy, c * qy + s * qx, c * qz + s * qw]
        return np.array([x + self.dx_m, y + self.dy_m, z, *turned])

    def nearest(self, test: TestSet, task: Task) -> Nearest:
        """Compared with the test tasks that move the same object of the same task.

        These move every other thing as well, each its own way, so even at distance zero the scenes would differ.
        """
        moved = [
            (float(other.parameters["dx_m"]), float(other.parameters["dy_m"]))
            for other in test.on(task, "pose")
            if other.parameters.get("target") == self.target is not None
        ]
        distance_m = min((math.hypot(self.dx_m - dx, self.dy_m - dy) for dx, dy in moved), default=math.inf)
        return Nearest(distance_m, len(moved))


class _Settled(NamedTuple):
    """How the target came to rest: what it touched at the start and at rest, and how far its pose is from the start."""

    started: Mapping[tuple[str, str], float]
    rested: Mapping[tuple[str, str], float]
    slid_m: float
    tilted_deg: float


def _settle(compiled: Compiled, target: str) -> _Settled:
    """Let the target come to rest from the compiled state while everything else is held."""
    import mujoco

    model, data = compiled.model, compiled.data
    part = compiled.part(f"{target}_main")
    joint = model.joint(f"{target}_joint0")
    pose, velocity = slice(joint.qposadr[0], joint.qposadr[0] + 7), slice(joint.dofadr[0], joint.dofadr[0] + 6)
    started, first = compiled.touching(part), data.qpos[pose].copy()
    held = data.qpos.copy()
    for _ in range(round(SETTLE_S / model.opt.timestep)):
        mujoco.mj_step(model, data)
        held[pose], moving = data.qpos[pose], data.qvel[velocity].copy()
        data.qpos[:], data.qvel[:] = held, 0.0
        data.qvel[velocity] = moving
    mujoco.mj_forward(model, data)
    cosine = min(1.0, abs(float(first[3:] @ held[pose][3:])))
    return _Settled(
        started,
        compiled.touching(part),
        float(np.linalg.norm(held[pose][:3] - first[:3])),
        2 * math.degrees(math.acos(cosine)),
    )


@dataclass(frozen=True)
class _Setting:
    """What a BDDL file says of the objects.

    Attributes:
        targets: the movable objects that the goal puts somewhere.
        anchors: object to the one thing it starts next to or the two it starts between.
        alike: object to the others of its category.
    """

    targets: tuple[str, ...]
    anchors: dict[str, tuple[str, ...]]
    alike: dict[str, tuple[str, ...]]


@cache
def _setting(task: Task) -> _Setting:
    named = re.split(r"\(:(\w+)", task.bddl_file.read_text())
    sections = dict(zip(named[1::2], named[2::2], strict=True))
    groups = [names.split() for names in re.findall(r"([\w\s]+?)\s-\s", sections["objects"])]
    alike = {name: tuple(other for other in group if other != name) for group in groups for name in group}
    goal = re.findall(r"\((?:On|In)\s+(\w+)\s", sections["goal"])
    start_of = dict(re.findall(r"\(On\s+(\w+)\s+(\w+)\)", sections["init"]))
    at = {region: name for name, region in start_of.items()}
    anchors = {}
    for name, region in start_of.items():
        # Such as main_table_between_plate_ramekin_region: the plate starts in main_table_plate_region.
        found = re.fullmatch(r"(\w+?)_(?:next_to_([a-z]+)|between_([a-z]+)_([a-z]+))_region", region)
        if found:
            surface, *words = (word for word in found.groups() if word)
            anchors[name] = tuple(at[f"{surface}_{word}_region"] for word in words)
    return _Setting(tuple(dict.fromkeys(name for name in goal if name in alike)), anchors, alike)


def _relation_holds(task: Task, target: str, xy_m: Callable[[str], Floats]) -> bool:
    """Whether the target still stands where the instruction's words place it.

    Next to something: within ``NEXT_TO_M`` of it, and no like object nearer to it. Between two things: its foot on the
    line between them in the middle half, and off that line by at most a quarter of its length.
    """
    setting = _setting(task)
    own = xy_m(target)
    match setting.anchors.get(target, ()):
        case (anchor,):
            away = np.linalg.norm(own - xy_m(anchor))
            nearest_alike = min(
                (np.linalg.norm(xy_m(o) - xy_m(anchor)) for o in setting.alike[target]), default=math.inf
            )
            return bool(away <= min(NEXT_TO_M, nearest_alike))
        case (first, second):
            line = xy_m(second) - xy_m(first)
            dx, dy = own - xy_m(first)
            along, beside = np.array([dx * line[0] + dy * line[1], dx * line[1] - dy * line[0]]) / (line @ line)
            return bool(BETWEEN <= along <= 1 - BETWEEN and abs(beside) <= BETWEEN)
    return True


class PoseAxis(Axis):
    """Displacements in all directions alike, and turns either way.

    At level k the displacement is k - 1 to k times ``step_m``, uniform over the ring, and the turn k - 1 to k times
    ``step_deg``. Where a task moves several objects, one is drawn.
    """

    step_m: PositiveFloat = 0.016
    step_deg: PositiveFloat = 4.0

    def sample(self, rng: np.random.Generator, task: Task, place: int) -> PosePerturbation:
        targets = _setting(task).targets
        level = self.draw_level(rng)
        reach_m = self.step_m * math.sqrt(rng.uniform((level - 1) ** 2, level**2))
        bearing_rad = rng.uniform(-math.pi, math.pi)
        dyaw_deg = self.step_deg * rng.uniform(level - 1, level) * rng.choice([-1, 1])
        return PosePerturbation(
            level=level,
            target=targets[rng.integers(len(targets))] if targets else None,
            dx_m=round(reach_m * math.cos(bearing_rad), 4),
            dy_m=round(reach_m * math.sin(bearing_rad), 4),
            dyaw_deg=round(float(dyaw_deg), 2),
        )
