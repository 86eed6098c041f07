"""Sources of demonstrations: the starter set, and LIBERO's own HDF5 files. Needs no simulator."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple, Protocol

import h5py
import numpy as np
import yaml

from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.libero import hdf5
from pipeline.libero.aliases import as_defined
from pipeline.libero.assets import package_folder, relocate
from pipeline.libero.recorder import reject_other_rate, reject_other_settings
from pipeline.libero.tasks import SUITES, base_of_test, find_task, suites, tasks
from pipeline.origins import REINSTALL
from pipeline.types import Demo, Floats, Task

LARGEST_STATE = 1e10
"""MuJoCo calls a simulation unstable when a position or a velocity passes this (``mjMAXVAL`` in ``mjmodel.h``)."""

ROUNDING = 1e-6
"""What a number may miss by that was stored in single precision."""

HUMAN, EXPANDED = "human", "expanded"
"""Who made a demonstration."""


@dataclass(frozen=True)
class DemoEntry:
    """A demonstration in a source's index: all that planning needs, without its arrays.

    Attributes:
        task, key, source, origin, sha256, perturbations, expanded_from_sha256: as in ``Demo``.
        steps: number of actions, 20 a second.
    """

    task: Task
    key: str
    source: str
    origin: str
    sha256: str
    steps: int
    perturbations: str = "[]"
    expanded_from_sha256: str | None = None

    @property
    def demo_id(self) -> str:
        return f"{self.task}/{self.key}"

    @classmethod
    def of(cls, demo: Demo) -> DemoEntry:
        return cls(
            demo.task,
            demo.key,
            demo.source,
            demo.origin,
            demo.sha256,
            len(demo.actions),
            demo.perturbations,
            demo.expanded_from_sha256,
        )


class Problem(NamedTuple):
    """Something in a source that cannot be used.

    Attributes:
        name: a demonstration's id, or ``<suite>/<task>`` when its whole file is unusable.
        error: why, and what to do.
    """

    name: str
    error: PipelineError


class DemoIndex(NamedTuple):
    """What a source holds. Every entry was read and checked once, so it can be loaded.

    Attributes:
        notes: what is used otherwise than its author may expect, by file.
    """

    entries: list[DemoEntry]
    problems: list[Problem]
    notes: tuple[str, ...] = ()


class DemoSource(Protocol):
    """Where demonstrations come from."""

    def index(self, wanted: Iterable[Task], per_task: int | None = None) -> DemoIndex:
        """The first ``per_task`` usable demonstrations of each task (all by default), and what was unusable."""

    def load(self, demo_id: str) -> Demo:
        """One demonstration, by ``<suite>/<task>/<key>``.

        Raises:
            PipelineError: when it is not there or cannot be used.
        """


class StarterSource:
    """One human LIBERO demonstration for each of the 130 tasks, carried by the package ``robouse``.

    Actions are rounded to six decimals; of the states only the first is there, and the scene's model is not.
    """

    def index(self, wanted: Iterable[Task], per_task: int | None = None) -> DemoIndex:
        del per_task  # There is one for each task, and a count is at least one.
        return DemoIndex([DemoEntry.of(self.of(task)) for task in wanted], [])

    def load(self, demo_id: str) -> Demo:
        demo = self.of(_parse(demo_id)[0])
        if demo.demo_id != demo_id:
            raise PipelineError(f"the starter set has no {demo_id}", expected=demo.demo_id)
        return demo

    def of(self, task: Task) -> Demo:
        """The task's one demonstration."""
        if task.suite not in SUITES:
            raise PipelineError(f"the starter set has no demonstration of {task}", expected="a LIBERO task")
        group = "libero-90" if task.suite == "libero_90" else "libero"
        name = f"{task.suite.replace('_', '-')}-{tasks(task.suite).index(task)}"
        folder = package_folder("robouse") / "bundled_tasks" / group / name
        try:
            front_matter = (folder / "task.md").read_text().split("\n---\n")[0]
            header = yaml.load(front_matter, Loader=yaml.CSafeLoader)["robouse"]
            recorded = json.loads((folder / "oracle" / "demo_actions.json").read_text())
            if (header["suite"], header["env"]) != (task.suite, task.name):
                raise ValueError(f"holds {header['suite']}/{header['env']}")
            key, source = recorded["demo"], f"{recorded['source']} {recorded['demo']}"
            actions, init_state = np.array(recorded["actions"], np.float64), np.array(header["init_state"], np.float64)
        except (OSError, ValueError, LookupError, TypeError, yaml.YAMLError) as error:
            what = f"no starter demonstration of {task} ({error})"
            raise PipelineError(what, where=folder, remedy=REINSTALL) from error
        return _Recorded(task, key, source, HUMAN, actions, init_state[None], None).checked(str(folder))


@dataclass(frozen=True)
class HDF5Source:
    """LIBERO's demonstrations as published: ``<root>/<suite>/<task>_demo.hdf5``, 50 in each file.

    Attributes:
        root: the folder that holds the suites.
    """

    root: Path

    def index(self, wanted: Iterable[Task], per_task: int | None = None) -> DemoIndex:
        wanted, entries = list(wanted), []
        suites_of_them = dict.fromkeys(task.suite for task in wanted)
        problems = [stray for suite in suites_of_them for stray in self._files_of_no_task(suite)]
        notes: list[str] = []
        first_with: dict[str, DemoEntry] = {}
        for task in wanted:
            usable, clipped = 0, {}
            try:
                with self._data(task) as data:
                    for key in hdf5.names(data, str(self._path(task))):
                        if usable == per_task:
                            break
                        try:
                            entry = DemoEntry.of(self._read(task, key, data))
                            # Episodes are identified by content: two copies would make two rows with one id.
                            if (first := first_with.setdefault(entry.sha256, entry)) is not entry:
                                raise PipelineError(
                                    f"holds the same actions, states and model as {first.demo_id}",
                                    where=f"{self._path(task)} data/{key}",
                                    remedy="nothing has to be done: of two copies a run uses the first",
                                )
                            entries.append(entry)
                            usable += 1
                            if outside := _outside(data, key, str(self._path(task))):
                                clipped[key] = outside
                        except PipelineError as error:
                            problems.append(Problem(f"{task}/{key}", error))
                notes += self._notes(task, clipped)
            except PipelineError as error:
                problems.append(Problem(str(task), error))
        return DemoIndex(entries, problems, tuple(notes))

    def load(self, demo_id: str) -> Demo:
        task, key = _parse(demo_id)
        with self._data(task) as data:
            return self._read(task, key, data)

    def lengths(self, task: Task) -> list[int]:
        """Actions of each demonstration that the file of a task holds; none where it is missing or cannot be read."""
        found = []
        with suppress(PipelineError), self._data(task) as data:
            for key in hdf5.names(data, str(self._path(task))):
                where = f"{self._path(task)} data/{key}"
                with suppress(PipelineError):
                    found.append(len(hdf5.array(hdf5.member(data, key, h5py.Group, where), "actions", where)))
        return found

    def _path(self, task: Task) -> Path:
        return self.root / task.suite / f"{task.name}_demo.hdf5"

    def _files_of_no_task(self, suite: str) -> Iterator[Problem]:
        """The files that are named after no task of LIBERO's list."""
        folder = self.root / suite
        if not folder.is_dir():
            raise PipelineError(
                "no such folder",
                where=folder,
                expected="<root>/<suite>/<task>_demo.hdf5",
                remedy="set demos.root to the folder that holds the suites, or use the starter set",
            )
        for path in sorted(folder.glob("*.hdf5")):
            try:
                find_task(suite, path.name.removesuffix("_demo.hdf5"))
            except PipelineError as error:
                yield Problem(f"{suite}/{path.name}", PipelineError(error.what, where=path, expected=error.expected))

    @contextmanager
    def _data(self, task: Task) -> Iterator[h5py.Group]:
        path = self._path(task)
        with hdf5.opened(path) as file:
            data = hdf5.member(file, "data", h5py.Group, str(path))
            # Of the places that name the task, only this one was corrected for publication; the tasks' earlier names
            # stay in env_args. A name that no task has counts as one of those.
            recorded = PurePosixPath(hdf5.text(data, "bddl_file_name", f"{path} data")).stem
            if base_of_test(recorded):
                raise PipelineError(
                    f"recorded in the test task {recorded!r} of LIBERO-Plus (bddl_file_name)",
                    where=path,
                    expected="recordings in scenes that the benchmark does not test",
                    remedy="leave it out of demos.tasks: a policy that is trained on it cannot be tested",
                )
            if recorded != task.name and any(recorded == other.name for suite in suites() for other in tasks(suite)):
                raise PipelineError(
                    f"named after one task but recorded for another, {recorded!r} (bddl_file_name)",
                    where=path,
                    remedy=f"rename it to {recorded}_demo.hdf5",
                )
            reject_other_settings(data, f"{path} data")
            yield data

    def _notes(self, task: Task, clipped: Mapping[str, int]) -> Iterator[str]:
        """What is used otherwise of a task's file.

        Args:
            clipped: demonstration to the number of its actions that are limited to [-1, 1].
        """
        path = self._path(task)
        with hdf5.opened(path) as file:
            if masks := hdf5.masks(file):
                yield f"{path}: mask/ ({', '.join(masks)}) is ignored: all demonstrations of data/ are used"
        if clipped:
            yield (
                f"{path}: {sum(clipped.values())} actions of {len(clipped)} demonstrations are limited to [-1, 1], as "
                f"robosuite does when it executes them, such as of {next(iter(clipped))}"
            )

    def _read(self, task: Task, key: str, data: h5py.Group) -> Demo:
        path = self._path(task)
        where = f"{path} data/{key}"
        if not re.fullmatch(r"demo_\d+", key):
            raise PipelineError("not a demonstration", where=where, expected="a group named demo_<number>")
        group = hdf5.member(data, key, h5py.Group, where)
        actions, states = hdf5.array(group, "actions", where), hdf5.array(group, "states", where)
        init_state = hdf5.numbers(group, "init_state", where)
        if len(states) != len(actions) or not (init_state is None or _same_state(init_state, states[0])):
            raise PipelineError(
                f"actions {actions.shape}, states {states.shape} and the attribute init_state do not agree",
                where=where,
                expected="one state for each action, the first of them equal to init_state",
                remedy=hdf5.AS_RECORDED,
            )
        reject_other_rate(states, where)
        # Named within the set, not on this machine: provenance must not change from machine to machine.
        source = f"{task.suite}/{path.name} {key}"
        origin = EXPANDED if hdf5.EXPANDED_FROM in group.attrs else HUMAN
        model_file = hdf5.text(group, "model_file", where)
        demo = _Recorded(task, key, source, origin, actions, states, model_file).checked(where)
        if origin == HUMAN:
            return demo
        changes = hdf5.text(group, "perturbations", where)
        return replace(demo, perturbations=changes, expanded_from_sha256=hdf5.origin_sha256(group))


class _Recorded(NamedTuple):
    """What a source has of a demonstration; states are (T, S), or (1, S) when only the first is known."""

    task: Task
    key: str
    source: str
    origin: str
    actions: Floats
    states: Floats
    model_file: str | None

    def checked(self, where: str) -> Demo:
        """The demonstration.

        Raises:
            PipelineError: when it cannot be used.
        """
        actions, states = self.actions, self.states
        fault = None
        if actions.ndim != 2 or actions.shape[1] != 7 or len(actions) == 0:
            fault = f"actions have shape {actions.shape}"
        elif states.ndim != 2 or states.shape[1] == 0:
            fault = f"states have shape {states.shape}"
        elif not (np.isfinite(actions).all() and np.isfinite(states).all()):
            fault = "actions or states hold NaN or infinity"
        elif np.abs(states).max() > LARGEST_STATE:
            fault = f"states reach {np.abs(states).max():.6g}"
        if fault:
            expected = f"actions (T, 7) and states (T, S), all finite and no state beyond {LARGEST_STATE:.0e}"
            raise PipelineError(fault, where=where, expected=expected, remedy=hdf5.AS_RECORDED)
        told = SCHEMA.action.gripper
        executed = _as_executed(actions)
        if other := told.others(executed[:, 6]):
            raise PipelineError(
                f"the gripper is told {min(other):g}",
                where=where,
                expected=f"{told.open:g} (open) or {told.close:g} (close) as the last number of each action",
                remedy="set each to the nearer of the two in a copy of the file",
            )
        # Hash the model as recorded: relocated, it would differ from machine to machine.
        content = hashlib.sha256()
        for array in (actions, states):
            content.update(repr(array.shape).encode())
            content.update(array.astype("<f8").tobytes())
        content.update((self.model_file or "").encode())
        if self.task.suite not in SUITES:  # LIBERO's own tasks change with its package only.
            content.update(self.task.bddl_file.read_bytes())
        model_xml = None
        if self.model_file is not None:
            model_xml = as_defined(relocate(self.model_file, where=f"{where} model_file"), self.task)
        whole = states if len(states) == len(actions) else None
        return Demo(*self[:4], content.hexdigest(), executed, states[0].copy(), whole, model_xml)


def _outside(data: h5py.Group, key: str, where: str) -> int:
    """How many actions of a demonstration robosuite limits."""
    actions = hdf5.array(data[key], "actions", where)
    return int((np.abs(actions).max(axis=1) > 1 + ROUNDING).sum())


def _as_executed(actions: Floats) -> Floats:
    """Actions (T, 7) as robosuite executes them: limited to [-1, 1], and a gripper's command that rounding left within
    ``ROUNDING`` of one of the two is that one."""
    executed = np.clip(actions, -1.0, 1.0)
    gripper, nearest = executed[:, 6], np.sign(executed[:, 6])
    executed[:, 6] = np.where(np.abs(gripper - nearest) <= ROUNDING, nearest, gripper)
    return executed


def _same_state(one: Floats, other: Floats) -> bool:
    """Whether two states (S,) are equal in single precision, which recorders that save space store them in."""
    with np.errstate(over="ignore"):
        return np.array_equal(one.astype(np.float32), other.astype(np.float32))


def _parse(demo_id: str) -> tuple[Task, str]:
    parts = demo_id.split("/")
    if len(parts) != 3:
        raise PipelineError(f"not a demonstration's id: {demo_id!r}", expected="<suite>/<task>/<key>")
    return find_task(parts[0], parts[1]), parts[2]
