"""Episodes an hour, ours beside the LIBERO class of vla-eval, the field's harness, with one model server for both.

    nice -n 10 python benchmarks/evaluation_speed.py [--tasks 'libero_goal/turn_on_the_stove' ...] [--states 2]
        [--steps 120]

The server replays demonstrations. The same episodes run in turn as the harness runs them, an action for each
observation; by ours in the same way; and by ours with answers in chunks of eight, so that it looks and asks once in
eight steps. Each with the agent view alone, which is all that the harness sends by default though it renders both, and
with both views. Episodes end after so many steps in all ways. The last line is the result as JSON, in wall time and in
CPU time of this process.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pipeline import gl

# Both render with what is chosen before robosuite is imported.
CHOICE = gl.choose()

from libero.libero.envs import OffScreenRenderEnv  # noqa: E402, F401 - imported with its renderer
from model_server import replaying  # noqa: E402
from robosuite.utils.binding_utils import MjSim  # noqa: E402
from vla_eval.benchmarks.libero.benchmark import LIBEROBenchmark  # noqa: E402
from vla_eval.connection import Connection  # noqa: E402
from vla_eval.runners.sync_runner import SyncEpisodeRunner  # noqa: E402

from pipeline.evaluation.environment import EpisodeEnvironment  # noqa: E402
from pipeline.evaluation.policies import Server, Wanted, checked_actions  # noqa: E402
from pipeline.evaluation.selection import Selection, select  # noqa: E402
from pipeline.evaluation.tasks import EvaluationTask  # noqa: E402

TASKS = ("turn_on_the_stove", "pick_up_the_milk_and_place_it_in_the_basket")
CHUNK = 8


class Times:
    """Wall and CPU seconds by what they were spent on; ``render`` inside of ``physics`` is not counted twice."""

    def __init__(self) -> None:
        self.wall_s: dict[str, float] = defaultdict(float)
        self.cpu_s: dict[str, float] = defaultdict(float)
        self._inner = [[0.0, 0.0]]

    @contextmanager
    def of(self, part: str) -> Iterator[None]:
        begun = time.perf_counter(), time.process_time()
        self._inner.append([0.0, 0.0])
        try:
            yield
        finally:
            wall_s, cpu_s = time.perf_counter() - begun[0], time.process_time() - begun[1]
            inner_wall_s, inner_cpu_s = self._inner.pop()
            self._inner[-1][0] += wall_s
            self._inner[-1][1] += cpu_s
            self.wall_s[part] += wall_s - inner_wall_s
            self.cpu_s[part] += cpu_s - inner_cpu_s

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            with self.of(part):
                return function(*arguments, **options)

        return call


class Harness:
    """The harness's own LIBERO class and runner, in this process."""

    def __init__(self, suite: str, address: str, both_views: bool, times: Times):
        self._benchmark = LIBEROBenchmark(suite, send_wrist_image=both_views, send_state=both_views, env_seed=0)
        self._tasks = {task["task_obj"].name: task for task in self._benchmark.get_tasks()}
        for part, name in (("reset", "reset"), ("physics", "step"), ("send", "make_obs")):
            setattr(self._benchmark, name, times.timed(part, getattr(self._benchmark, name)))
        self._loop = asyncio.new_event_loop()
        self._connection = Connection(address)
        self._loop.run_until_complete(self._connection.connect(benchmark="LIBEROBenchmark"))

    def run(self, task: EvaluationTask, steps: int) -> int:
        named = {**self._tasks[task.base], **task.for_harness(), "episode_idx": task.number}
        episode = SyncEpisodeRunner().run_episode(self._benchmark, named, self._connection, max_steps=steps)
        return int(self._loop.run_until_complete(episode)["steps"])

    def close(self) -> None:
        self._benchmark.cleanup()
        self._loop.run_until_complete(self._connection.close())


class Ours:
    """One of this project's environments and its client of the server."""

    def __init__(self, address: str, both_views: bool, times: Times):
        self._environment, self._server = EpisodeEnvironment(), Server(address)
        self._server.wanted = Wanted(wrist=both_views, state=both_views)
        self._times = times

    def run(self, task: EvaluationTask, steps: int) -> int:
        environment, times = self._environment, self._times
        with times.of("reset"):
            progress = environment.reset(task)
        self._server.begin(task)
        while not progress.over and progress.steps < steps:
            actions = checked_actions(self._server.act(times.timed("render", environment.observation)), "server")
            for action in actions[: steps - progress.steps]:
                if not progress.over:
                    with times.of("physics"):
                        progress = environment.step(action)
        self._server.end(progress.success)
        return progress.steps

    def close(self) -> None:
        self._environment.close()
        self._server.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--states", type=int, default=2, help="initial states of each task")
    parser.add_argument("--steps", type=int, default=120, help="after which every episode ends")
    arguments = parser.parse_args()
    episodes = select(Selection(tasks=tuple(arguments.tasks), episodes=arguments.states))
    results: dict[str, Any] = {"device": CHOICE.device, "episodes": len(episodes)}
    with replaying(1) as address, replaying(CHUNK) as in_chunks:
        for views, both_views in (("agent_view", False), ("both_views", True)):
            results[views] = compared(episodes, arguments.steps, address, in_chunks, both_views)
            print(f"{views}: {json.dumps(results[views])}")
    print(json.dumps(results))


def compared(
    episodes: list[EvaluationTask], steps: int, address: str, in_chunks: str, both_views: bool
) -> dict[str, Any]:
    """Run the episodes in all ways in turn; what each way took, and by how much ours is faster."""
    times = {name: Times() for name in ("harness", "ours", f"ours_look_in_{CHUNK}")}
    harnesses: dict[str, Harness] = {}
    ours = {
        name: Ours(at, both_views, times[name])
        for name, at in (("ours", address), (f"ours_look_in_{CHUNK}", in_chunks))
    }
    render, taken = MjSim.render, dict.fromkeys(times, 0)
    MjSim.render = times["harness"].timed("render", render)
    for task in episodes:
        if task.suite not in harnesses:
            with times["harness"].of("reset"):
                harnesses[task.suite] = Harness(task.suite, address, both_views, times["harness"])
        ways: dict[str, Harness | Ours] = {"harness": harnesses[task.suite], **ours}
        for name, way in ways.items():
            with times[name].of("server"):
                taken[name] += way.run(task, steps)
            print(f"{task} {name}: {taken[name]} steps, {sum(times[name].wall_s.values()):.1f} s", flush=True)
    MjSim.render = render
    opened: list[Harness | Ours] = [*harnesses.values(), *ours.values()]
    for way in opened:
        way.close()
    figures: dict[str, Any] = {name: figures_of(times[name], taken[name], len(episodes)) for name in times}
    for name in ours:
        for kind in ("wall", "cpu"):
            ratio = figures["harness"][f"{kind}_s"] / figures[name][f"{kind}_s"]
            figures[name][f"times_faster_{kind}"] = round(ratio, 2)
    return figures


def figures_of(times: Times, steps: int, episodes: int) -> dict[str, Any]:
    wall_s, cpu_s = sum(times.wall_s.values()), sum(times.cpu_s.values())
    return {
        "steps": steps,
        "wall_s": round(wall_s, 1),
        "cpu_s": round(cpu_s, 1),
        "episodes_an_hour": round(3600 * episodes / wall_s, 1),
        "wall_s_by_part": {part: round(seconds, 2) for part, seconds in times.wall_s.items()},
    }


if __name__ == "__main__":
    main()
