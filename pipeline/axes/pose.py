"""Pose: places of things at the start: of the object that a task moves, of its receptacle, or of the whole scene.

Physics layer. In the component ``scene`` every object and fixture gets its own displacement, as in LIBERO-Plus.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import combinations
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from pipeline.axes.base import LEVELS, Axis, Level, Perturbation, PhysicsPerturbation, Share, pick, sample_point
from pipeline.axes.report_data import (
    BENCHMARK,
    CoveragePlots,
    KeptPerturbation,
    Measures,
    ObservedEpisode,
    Plot,
    Scatter,
    Strips,
)
from pipeline.libero.arenas import ARENAS
from pipeline.libero.carried import definition_of
from pipeline.libero.task_goal import instruction_holds
from pipeline.libero.tasks import Same, find_task
from pipeline.testset.benchmark import TestSet, TestTask
from pipeline.types import Demo, Floats, Frozen, RollOut, Scene, Task

Component = Literal["target", "receptacle", "scene"]
"""Moved part of the scene: the object that the goal places, the movable object that it is put on or in, or all things.
"""

STEP_M = {"libero_spatial": 0.01, "libero_object": 0.03, "libero_goal": 0.02, "libero_10": 0.01}
WIDER_M = {"LIVING_ROOM_SCENE1": 0.02}
"""Radius of LIBERO-Plus's disks at level 1, by suite, and for the one scene that differs; level k has k times it.

Tasks that LIBERO-Plus leaves out, LIBERO-90's and the user's own, have the disks of the long suite."""

BASE_M = {"akita_black_bowl_1": (0.35, 0.05), "cream_cheese_1": (0.15, 0.10), "wine_bottle_1": (0.0, 0.05)}
"""Displacement of things in the goal suite from LIBERO's own places, which LIBERO-Plus applies before its disks."""

REACH_M = 0.82
"""Reach of the hand, pointing down, from its base at the height of a table; the replay shows if it grasps there.

A scripted grasp lifted the goal suite's cream cheese from 0.73 to 0.81 m in 5 of 5 test scenes. LIBERO-Plus puts the
bowl 0.85 to 1.02 m away. There the grasp lifted it in 11 of 15 scenes with the hand turned by 90 degrees. With the hand
as in the demonstrations it lifted the bowl in none of 10. None of 20 replays put the cream cheese in the bowl there. In
91 test scenes the bowl is therefore further away than in any sampled scene. In 73 of them the hand takes it, in 18 it
receives the cream cheese."""

APART, CLOSE_M = 0.75, 0.15
"""Share of the distance in LIBERO's file that the centres of two objects' regions keep at least, up to ``CLOSE_M``."""

FIXTURE_APART, FIXTURE_CLOSE_M = 0.9, 0.25
"""``APART`` and ``CLOSE_M`` for pairs with a fixture, which is larger."""

MOST_ATTEMPTS = 200
"""Most attempts to sample a scene that keeps its relations; the last scene is then left to be rejected."""


Shifts = dict[str, tuple[float, float]]
"""Name of a thing to its displacement (dx, dy) in m."""

_ShiftsByTask = dict[Task, list[tuple[str, Shifts]]]
"""LIBERO task to the displacements of its test tasks, by their names, or of a run's episodes, without names."""


class Move(Frozen):
    """Displacement of one thing along the world's axes from its place in the demonstration."""

    name: str
    dx_m: float
    dy_m: float


class _PosePerturbation(PhysicsPerturbation):
    """Base class of all perturbations of the axis.

    Attributes:
        source_moves: displacements of things in the perturbed demonstration from their places in LIBERO's own scene,
            which an expansion added. Distances measure both displacements together; `apply` adds its own alone.
    """

    source_moves: tuple[Move, ...] = Field(default=(), exclude_if=lambda moves: not moves)

    same: ClassVar[Same | None] = "scene"

    @property
    def shifts(self) -> Shifts:
        """Displacement of each thing from its place in the demonstration."""
        raise NotImplementedError

    @property
    def shifts_in_all(self) -> Shifts:
        """Displacement of each thing from its place in LIBERO's own scene."""
        total = _shifts(self.source_moves)
        for name, (dx_m, dy_m) in self.shifts.items():
            source_dx_m, source_dy_m = total.get(name, (0.0, 0.0))
            total[name] = (round(source_dx_m + dx_m, 6), round(source_dy_m + dy_m, 6))
        return total

    def after(self, earlier: Sequence[Perturbation]) -> Self:
        """Return this change with the displacements of an ``earlier`` change of the axis as ``source_moves``."""
        shifts = _shifts_of(earlier)
        return self.model_copy(update={"source_moves": _moves(shifts)}) if shifts else self

    def in_scene(self, task: Task) -> Self:
        """Return this change with the names that things have in all tasks with the initial scene of ``task``."""
        source = {_scene_name(task, name): shift for name, shift in _shifts(self.source_moves).items()}
        return self.model_copy(update={"source_moves": _moves(source)})


def _shifts(moves: Iterable[Move]) -> Shifts:
    """Map the name of each moved thing to its displacement."""
    return {move.name: (move.dx_m, move.dy_m) for move in moves}


def _shifts_of(earlier: Sequence[Perturbation]) -> Shifts:
    """Return the displacements of the change of this axis among ``earlier`` changes; empty without one."""
    for perturbation in earlier:
        if isinstance(perturbation, _PosePerturbation):
            return perturbation.shifts_in_all
    return {}


def _moves(shifts: Shifts) -> tuple[Move, ...]:
    """List displacements as moves, the reverse of ``_shifts``."""
    return tuple(Move(name=name, dx_m=dx_m, dy_m=dy_m) for name, (dx_m, dy_m) in shifts.items())


class PosePerturbation(_PosePerturbation):
    """One object moved in the horizontal plane and turned on the spot.

    Attributes:
        moved: the object's name in the BDDL file.
        dx_m, dy_m: displacement along the world's axes from the object's place in the demonstration.
        dyaw_deg: counter-clockwise turn about the vertical through its origin.
    """

    axis: Literal["pose"] = "pose"
    component: Literal["target", "receptacle"]
    moved: str
    dx_m: float
    dy_m: float
    dyaw_deg: float

    # A quarter of the 2 cm square that LIBERO's own reset scatters an object in.
    clearance: ClassVar[float] = 0.005
    unit: ClassVar[str | None] = "m"
    measure: ClassVar[str] = "the norm of the difference between the displacements of the same object"

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """Return the scene with the object moved; its height and velocity and all other things stay as they are.

        Raises:
            RejectedError: see ``pipeline.scenes.moving.move_one``.
        """
        from pipeline.scenes.moving import move_one

        return move_one(scene, demo.task, self.moved, (self.dx_m, self.dy_m), self.dyaw_deg)

    def distances_on(self, test: TestSet, task: Task) -> Floats:
        """Return the distances (N,) to the test tasks that move this object, alone or with other things.

        The test tasks also move every other thing, so their scenes would differ from this one even at distance zero.
        """
        return self._distances_m(_test_moves_m(test, task, self.moved))

    @property
    def shifts(self) -> Shifts:
        """Displacement of the object from its place in the demonstration."""
        return {self.moved: (self.dx_m, self.dy_m)}

    def in_scene(self, task: Task) -> Self:
        """Return this change with the object's name in all tasks with the initial scene of ``task``."""
        return super().in_scene(task).model_copy(update={"moved": _scene_name(task, self.moved)})

    def distances_to(self, others: Sequence[PosePerturbation]) -> Floats:
        """Return the distances (N,) to perturbations that move this object; NaN for those of another object."""
        return self._distances_m([p.shifts_in_all[p.moved] if p.moved == self.moved else NOWHERE for p in others])

    def _distances_m(self, moves_m: ArrayLike) -> Floats:
        """Return the distances (N,) to moves (N, 2) of this object."""
        return np.asarray(np.linalg.norm(np.subtract(moves_m, self.shifts_in_all[self.moved]), axis=1))


NOWHERE = (math.nan, math.nan)
"""Placeholder for the move of a thing that stays."""


@cache
def _test_moves_m(test: TestSet, task: Task, moved: str) -> Floats:
    """Return the displacement (N, 2) of a thing in each of the axis's test tasks in the scene of ``task``.

    The displacement is NaN if the thing stays. A test task of another task may call the thing by another name.
    """
    name = _scene_name(task, moved)
    moves_m = [shifts.get(name, NOWHERE) for shifts in _test_shifts(test, task)]
    return np.array(moves_m).reshape(-1, 2)


@cache
def _test_shifts(test: TestSet, task: Task) -> list[Shifts]:
    """List the displacements in each of the axis's test tasks in the scene of ``task``, by names in the scene."""
    listed = []
    for tested in test.on(task, "pose", "scene"):
        base = find_task(tested.suite, tested.base)
        moves = displacements(tested.parameters)
        listed.append({_scene_name(base, name): shift for name, shift in moves.items()})
    return listed


def _scene_name(task: Task, thing: str) -> str:
    """Return the name that a task's thing has in every task with the initial scene of ``task``."""
    return definition_of(task).scene_names.get(thing, thing)


class ScenePerturbation(_PosePerturbation):
    """Every object and fixture moved in the horizontal plane.

    Attributes:
        moves: displacement of each thing by its name in the BDDL file. A thing on or in another moves with it.
        disk_level: level of the disks, if things first got LIBERO-Plus's places; ``level`` is then 5.
    """

    axis: Literal["pose"] = "pose"
    component: Literal["scene"] = "scene"
    moves: Annotated[tuple[Move, ...], Field(min_length=1)]
    disk_level: Level | None = Field(default=None, exclude_if=lambda level: level is None)

    # A test scene is one stored state. LIBERO's reset put each thing anywhere in a square around the middle of its
    # moved region. The side of the square is 2 cm in the spatial and goal suites and 5 cm in most of the others. From
    # 1 cm on, at least one thing is outside of the 2 cm around its place in the test scene: the reset's own scatter of
    # all things cannot make the two scenes equal. A clearance of 5 cm is impossible: at level 1 of the long suite the
    # disks are smaller.
    clearance: ClassVar[float] = 0.01
    unit: ClassVar[str | None] = "m"
    measure: ClassVar[str] = "the largest difference along an axis between the displacements of the same thing"

    def apply(self, scene: Scene, demo: Demo, roll_out: RollOut) -> Scene:
        """Return the scene with all things moved; heights, rotations, velocities and joints stay as they are.

        Raises:
            RejectedError: see ``pipeline.scenes.moving.move``.
        """
        from pipeline.scenes.moving import move

        return move(scene, demo.task, self.shifts)

    def distances_on(self, test: TestSet, task: Task) -> Floats:
        """Return the distances (N,) to the test tasks, over all things that both move."""
        return self._distances_m(lambda name: _test_moves_m(test, task, name))

    def in_scene(self, task: Task) -> Self:
        """Return this change with the names that things have in all tasks with the initial scene of ``task``."""
        shifts = {_scene_name(task, name): shift for name, shift in self.shifts.items()}
        return super().in_scene(task).model_copy(update={"moves": _moves(shifts)})

    def distances_to(self, others: Sequence[ScenePerturbation]) -> Floats:
        """Return the distances (N,) to N perturbations, over all things that both move."""
        shifts_of_others = [perturbation.shifts_in_all for perturbation in others]
        return self._distances_m(lambda name: [shifts.get(name, NOWHERE) for shifts in shifts_of_others])

    def observe(self, episode: ObservedEpisode) -> Iterator[tuple[str, float]]:
        """Measure the displacements of the objects that the task moves."""
        return _targets_moved(episode.task, self.shifts_in_all, self.level)

    @property
    def shifts(self) -> Shifts:
        """Displacement of each thing from its place in the demonstration."""
        return _shifts(self.moves)

    def _distances_m(self, moves_m: Callable[[str], ArrayLike]) -> Floats:
        """Return the distances (N,) to scenes, given a function from a thing's name to its moves (N, 2)."""
        shifts = self.shifts_in_all
        offsets_m = [np.subtract(moves_m(move.name), shifts[move.name]) for move in self.moves]
        return np.asarray(np.fmax.reduce([np.abs(offset_m).max(axis=1) for offset_m in offsets_m]))


def displacements(parameters: Mapping[str, object]) -> Shifts:
    """Read the displacement of each object and fixture from the ``parameters`` of one of the axis's test tasks."""
    # Such as plate_1:0.01,-0.02;flat_stove_1:0,0.03.
    listed = re.findall(r"([^;:]+):([^,]+),([^;]+)", str(parameters.get("moves", "")))
    return {name: (float(dx_m), float(dy_m)) for name, dx_m, dy_m in listed}


def sample_scene(
    rng: np.random.Generator, level: Level, task: Task, base_shifts_m: Shifts, source_shifts_m: Shifts | None = None
) -> ScenePerturbation:
    """Sample moves uniform over the disks of a level, again if they break the scene that the task's file defines.

    The file gives the middle of each thing's region. At the new places the relation that the instruction names must
    hold, and the hand must reach the objects that it has to grasp. No two things may come much closer than before.

    Args:
        base_shifts_m: displacements of things from LIBERO's own places before those of the disks.
        source_shifts_m: displacements of things in the perturbed demonstration from LIBERO's own places.
    """
    source_shifts_m = source_shifts_m or {}
    definition = definition_of(task)
    carriers, centres_m = definition.carriers, definition.centres_m
    radius_m = level * _disk_m(task)
    for _ in range(MOST_ATTEMPTS):
        shifts_m = _sample_shifts(rng, carriers.values(), radius_m, base_shifts_m, source_shifts_m)
        xy_m = {}
        for thing, carrier in carriers.items():
            xy_m[thing] = centres_m[thing] + np.add(source_shifts_m.get(thing, (0.0, 0.0)), shifts_m[carrier])
        if _fits(task, xy_m):
            break
    moves = []
    for thing, carrier in carriers.items():
        dx_m, dy_m = shifts_m[carrier]
        moves.append(Move(name=thing, dx_m=float(dx_m), dy_m=float(dy_m)))
    return ScenePerturbation(level=level, moves=tuple(moves))


def _sample_shifts(
    rng: np.random.Generator, carriers: Iterable[str], radius_m: float, base_shifts_m: Shifts, source_shifts_m: Shifts
) -> dict[str, Floats]:
    """Sample the displacement (2,) of each carrier from its place in the demonstration, for one attempt.

    Args:
        carriers: things that stand on the working surface; repeated names count once.
        radius_m: radius of the disks.
        base_shifts_m, source_shifts_m: as for ``sample_scene``.
    """
    shifts_m: dict[str, Floats] = {}
    for carrier in dict.fromkeys(carriers):
        offset_m = _sample_offset_m(rng, radius_m)
        base_m: ArrayLike = (0.0, 0.0)
        if carrier in base_shifts_m:
            base_m = np.subtract(base_shifts_m[carrier], source_shifts_m.get(carrier, (0.0, 0.0)))
        shifts_m[carrier] = np.round(np.add(base_m, offset_m), 4)
    return shifts_m


def _sample_offset_m(rng: np.random.Generator, radius_m: float) -> tuple[float, float]:
    """Sample a point (x, y), uniform over the disk around the origin."""
    reach_m = radius_m * math.sqrt(rng.uniform())
    bearing_rad = rng.uniform(-math.pi, math.pi)
    return reach_m * math.cos(bearing_rad), reach_m * math.sin(bearing_rad)


def _benchmark_shifts_m(task: Task) -> Shifts:
    """Return the displacements of ``BASE_M`` for a task of the goal suite, if the hand can then reach the object."""
    if task.suite != "libero_goal":
        return {}
    centres_m = definition_of(task).centres_m
    shifts_m = {}
    for name, shift_m in BASE_M.items():
        if _within_reach(task, name, np.add(centres_m[name], shift_m)):
            shifts_m[name] = shift_m
    return shifts_m


def _disk_m(task: Task) -> float:
    """Return the radius of a task's disks at level 1."""
    for scene, radius_m in WIDER_M.items():
        # A carried task begins in the scene of another task's file.
        if task.bddl_file.stem.startswith(scene):
            return radius_m
    return STEP_M.get(task.suite, 0.01)


def _fits(task: Task, xy_m: dict[str, Floats]) -> bool:
    """Return whether things at ``xy_m`` (2,), in the frame of their surface, keep the task's relations and distances.

    The objects that the task needs must also be within the hand's reach.
    """
    definition = definition_of(task)
    centres_m = definition.centres_m
    alone = [thing for thing, carrier in definition.carriers.items() if thing == carrier]
    for first, second in combinations(alone, 2):
        apart_m = math.dist(centres_m[first], centres_m[second])
        both_objects = {first, second} <= definition.objects.keys()
        least_m = min(CLOSE_M, APART * apart_m) if both_objects else min(FIXTURE_CLOSE_M, FIXTURE_APART * apart_m)
        if math.dist(xy_m[first], xy_m[second]) < least_m:
            return False
    if not all(_within_reach(task, thing, place_m) for thing, place_m in xy_m.items()):
        return False
    return instruction_holds(task, xy_m.__getitem__)


def _within_reach(task: Task, thing: str, place_m: Floats) -> bool:
    """Return whether the hand reaches a thing at ``place_m`` (2,); true if it is no object that the task needs."""
    definition = definition_of(task)
    if thing not in definition.objects or thing not in definition.of_interest:
        return True
    robot_m = (ARENAS[definition.arena].robot_x_m, 0.0)
    return math.dist(place_m, robot_m) <= max(REACH_M, math.dist(definition.centres_m[thing], robot_m))


class PoseAxis(Axis):
    """Displacements in all directions with equal probability.

    The component ``scene`` moves everything at once, as LIBERO-Plus does: see ``sample_scene``. The other components
    move and turn one object, sampled with equal probability from the objects of the task that they can move.

    Attributes:
        levels: Levels to sample, 1 (weak) to 5 (strong), all five by default. Each entry has equal probability, except
            for scenes with LIBERO-Plus's places, which have level 5.
        components: Components to sample: ``scene`` moves all objects, ``target`` an object that the task moves, and
            ``receptacle`` an object that receives it. Each entry has equal probability; ``scene`` by default.
        benchmark_places: Share of the goal suite's scenes in which three objects first get LIBERO-Plus's places, up to
            35 cm away; 1 by default. Such a scene has level 5, and occurs only if ``levels`` contains 5.
        step_m: Width of a level's ring in m, not for ``scene``: at level k, an object moves by k - 1 to k times this
            distance; 0.016 by default.
        turn_deg: Largest turn of an object to either side at every level, in degrees, not for ``scene``; 20 by default.
    """

    kinds: ClassVar = (PosePerturbation, ScenePerturbation)
    colour: ClassVar = "#d463b0"
    dimension: ClassVar = "layout"
    test_name: ClassVar = "displaced targets"
    test_scene: ClassVar = "bddl"

    components: Annotated[tuple[Component, ...], Field(min_length=1)] = ("scene",)
    benchmark_places: Share = 1.0
    step_m: float = Field(default=0.016, ge=0.0001, le=0.2)
    turn_deg: float = Field(default=20.0, ge=0.0, le=180.0)

    def applies(self, task: Task) -> bool:
        """Return whether the task has a thing to move: some tasks only open, close or turn things in place."""
        return bool(self._movable(task))

    def _movable(self, task: Task) -> dict[Component, tuple[str, ...]]:
        """Map each configured component that moves a thing of the task to these things; ``scene`` moves ``all``."""
        definition = definition_of(task)
        all_places_known = definition.places and definition.centres_m.keys() == definition.places.keys()
        movable: dict[Component, tuple[str, ...]] = {
            "target": definition.targets,
            "receptacle": definition.receptacles,
            "scene": ("all",) if all_places_known else (),
        }
        return {component: movable[component] for component in self.components if movable[component]}

    @classmethod
    def level_of_test(cls, tested: TestTask) -> int:
        """Return the benchmark's own level, which sets the radius of its disks; in the goal suite 5.

        There, objects first get places that are up to 35 cm away.
        """
        return 5 if tested.suite == "libero_goal" else int(tested.parameters["level"])

    def levels_set_shares(self, task: Task) -> bool:
        """Return whether no scene has level 5 for LIBERO-Plus's places."""
        return self.benchmark_places == 0 or 5 not in self.levels or not _benchmark_shifts_m(task)

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> PosePerturbation | ScenePerturbation:
        return self.sample_after(rng, task, entry_index, ())

    def sample_after(
        self, rng: np.random.Generator, task: Task, entry_index: int, earlier: Sequence[Perturbation]
    ) -> PosePerturbation | ScenePerturbation:
        movable = self._movable(task)
        component = pick(rng, [component for component in self.components if component in movable])
        moved = pick(rng, movable[component])
        level = self.sample_level(rng)
        if component == "scene":
            return self._sample_moved_scene(rng, level, task, _shifts_of(earlier)).after(earlier)
        dx_m, dy_m = sample_point(rng, self.step_m * math.sqrt(rng.uniform((level - 1) ** 2, level**2)))
        turn_deg = round(rng.uniform(-self.turn_deg, self.turn_deg), 2)
        move = PosePerturbation(level=level, component=component, moved=moved, dx_m=dx_m, dy_m=dy_m, dyaw_deg=turn_deg)
        return move.after(earlier)

    def _sample_moved_scene(
        self, rng: np.random.Generator, level: Level, task: Task, source_shifts_m: Shifts
    ) -> ScenePerturbation:
        """Sample a scene from the demonstration's own places, or in the goal suite from the benchmark's."""
        base_shifts_m = _benchmark_shifts_m(task)
        if not base_shifts_m or 5 not in self.levels or rng.random() >= self.benchmark_places:
            return sample_scene(rng, level, task, {}, source_shifts_m)
        disk_level = pick(rng, LEVELS)
        scene = sample_scene(rng, disk_level, task, base_shifts_m, source_shifts_m)
        return scene.model_copy(update={"level": 5, "disk_level": disk_level})

    @classmethod
    def observe_tests(cls, test: TestSet) -> Iterator[tuple[str, float]]:
        """Measure the displacements of each test task's targets, and the distance to the nearest other test task."""
        shifts_by_task: _ShiftsByTask = defaultdict(list)
        for tested in test.on_axis("pose"):
            task = find_task(tested.suite, tested.base)
            shifts = displacements(tested.parameters)
            yield from _targets_moved(task, shifts, cls.level_of_test(tested))
            shifts_by_task[task].append((tested.name, shifts))
        yield from _to_nearest(test, shifts_by_task)

    @classmethod
    def observe_together(cls, kept: Sequence[KeptPerturbation[_PosePerturbation]], test: TestSet) -> Measures:
        """Measure the distance from each test task to the nearest of all episodes of its task.

        A test task is left out if no episode moves one of its objects of interest.
        """
        shifts_by_task: _ShiftsByTask = defaultdict(list)
        for item in kept:
            shifts_by_task[item.task].append(("", item.perturbation.shifts_in_all))
        return _to_nearest(test, shifts_by_task)

    @classmethod
    def describe_coverage(
        cls, kept: Sequence[KeptPerturbation[PosePerturbation | ScenePerturbation]], test: TestSet
    ) -> CoveragePlots:
        """Describe plots of the displacements of one object, and of all things of a scene."""
        tested = [task.parameters for task in test.on_axis("pose")]
        targets = [(parameters["dx_m"], parameters["dy_m"]) for parameters in tested if "dx_m" in parameters]
        alone, scenes = [], []
        for item in kept:
            if isinstance(item.perturbation, PosePerturbation):
                alone.append(item.perturbation)
            else:
                scenes.append(item.perturbation)
        plots: list[Plot] = []
        if alone:
            turns = {"yaw": {"pose": np.array([p.dyaw_deg for p in alone])}}
            plots.append(_plot_shifts("Displacement of the moved object", targets, [(p.dx_m, p.dy_m) for p in alone]))
            plots.append(Strips("Rotation of the moved object", turns, "degrees"))
        if scenes or not alone:
            moved: list[tuple[float, float]] = []
            for parameters in tested:
                moved += displacements(parameters).values()
            shifts_m = [(move.dx_m, move.dy_m) for scene in scenes for move in scene.moves]
            plots.append(_plot_shifts("Displacement of all objects of a scene", moved, shifts_m))
        return CoveragePlots(
            f"{len(targets):,} of {len(tested):,} test tasks move the target; all of them move all other objects as "
            f"well. {len(scenes)} of {len(kept)} perturbations move the whole scene. No test task turns an object.",
            plots,
        )


def _plot_shifts(title: str, tested_m: Sequence[object], shifts_m: Sequence[object]) -> Scatter:
    """Describe a plot of displacements (dx, dy) in m, of test tasks and of perturbations."""
    groups = {
        BENCHMARK: 100 * np.array(tested_m, float).reshape(-1, 2),
        "pose": 100 * np.array(shifts_m, float).reshape(-1, 2),
    }
    return Scatter(title, groups, "dx (cm)", "dy (cm)", equal=True)


def _targets_moved(task: Task, shifts: Shifts, level: int) -> Iterator[tuple[str, float]]:
    """Measure the displacements of the objects that a task moves."""
    for target in definition_of(task).targets:
        if target in shifts:
            moved_cm = 100 * float(np.hypot(*shifts[target]))
            yield f"displacement of the target in {task.suite}, level {level} (cm)", moved_cm


def _to_nearest(test: TestSet, shifts_by_task: _ShiftsByTask) -> Iterator[tuple[str, float]]:
    """Measure the distance of each test task's objects of interest to their nearest places under other names."""
    for tested in test.on_axis("pose"):
        task = find_task(tested.suite, tested.base)
        tested_shifts = displacements(tested.parameters)
        others = [shifts for name, shifts in shifts_by_task[task] if name != tested.name]
        for thing in definition_of(task).things_of_interest:
            if thing not in tested_shifts:
                continue
            apart_m = [math.dist(tested_shifts[thing], shifts[thing]) for shifts in others if thing in shifts]
            if apart_m:
                yield f"distance of a test object in {task.suite} to its nearest placement (cm)", 100 * min(apart_m)
