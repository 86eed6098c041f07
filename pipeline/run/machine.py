"""Trial that shows whether this machine computes the same results as the machine that began a run.

Versions alone do not show that. The trial computes ten control steps and a frame. Their digests are recorded with
recipes, versions and device. A run that has files resumes only if the same versions and device give the same digests.
"""

import hashlib
import platform
import time
import timeit
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

from pipeline import gl
from pipeline.config import ReplayConfig
from pipeline.errors import PipelineError
from pipeline.files import read_json, write_json
from pipeline.identity import fingerprint, made_with
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.run.layout import FINISHED, FRAMES, MACHINE, TRAJECTORIES
from pipeline.run.run import Run
from pipeline.stores.store import SUFFIX

SPEED = f"{FINISHED}/speed.json"
"""File of a run's folder with the speed of the machine, from which ``status`` estimates the remaining time."""

STORES = {"ten steps": (TRAJECTORIES, FRAMES), "one frame": (FRAMES,)}
"""Map of each part of a trial to the folders whose files it represents."""

TRIAL_TASK, TRIAL_STEPS = ("libero_goal", "turn_on_the_stove"), 10
"""Task and number of control steps that a trial simulates and renders."""


class Speed(NamedTuple):
    """Speed of this machine.

    Attributes:
        step_s: time of one core for a control step.
        frame_s: time for a frame of the trial's scene by the plain renderer, of one core or of one GPU.
        gpus: number of GPUs; 0 if the processor renders.
    """

    step_s: float
    frame_s: float
    gpus: int = 0


class Trial(NamedTuple):
    """Result of a trial.

    Attributes:
        digests: digests of ten control steps and of a frame after them, and the device that rendered the frame.
        speed: speed of this machine.
    """

    digests: Mapping[str, str]
    speed: Speed


@cache
def trial() -> Trial:
    """Simulate ten control steps and render a frame, in about five seconds."""
    from pipeline.physics.environment import Environment
    from pipeline.physics.replay import replay
    from pipeline.rendering.plain_renderer import PlainRenderer
    from pipeline.rendering.renderer import Renderer

    demo = StarterSource().demonstration(find_task(*TRIAL_TASK))
    environment = Environment(demo.task)
    short = replace(demo, actions=demo.actions[:TRIAL_STEPS])
    trajectory = replay(environment, short, "trial", ReplayConfig(mode="open_loop", noops="keep"))
    step_s = _seconds(lambda: environment.step(demo.actions[TRIAL_STEPS]))
    environment.close()
    renderer = Renderer(trajectory.model_xml)
    renderer.restore(trajectory.states[-1], trajectory.site_alpha[-1])
    frame = renderer.frame("agentview")
    renderer.close()
    plain = Renderer(renderer.model, PlainRenderer(renderer.model))
    plain.restore(trajectory.states[-1], trajectory.site_alpha[-1])
    gpus = 0 if gl.choose().software else max(1, len(gl.gpus()))
    frame_s = _seconds(lambda: plain.frame("agentview"), gpus > 0)
    plain.close()
    digests = {
        "OpenGL device": gl.choose().device,
        "ten steps": hashlib.sha256(trajectory.states.tobytes()).hexdigest()[:16],
        "one frame": hashlib.sha256(frame.tobytes()).hexdigest()[:16],
    }
    return Trial(digests, Speed(step_s, frame_s, gpus))


def _seconds(call: Callable[[], object], gpu: bool = False) -> float:
    """Return the time of the quickest of ten calls, in s.

    For a processor it is processor time, on which other work has little effect. For a GPU it is wall-clock time.
    """
    timer = time.perf_counter if gpu else time.process_time
    return min(timeit.repeat(call, number=1, repeat=10, timer=timer))


def host() -> list[list[str]]:
    """Return this machine's name and kernel, and the models of its processors."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    models = {line for line in lines if line.startswith("model name")}
    return [list(platform.uname()), sorted(models)]


def keep_speed(run: Run, speed: Speed) -> None:
    """Store the speed for ``status``; no generated file depends on it."""
    run.path(SPEED).parent.mkdir(exist_ok=True)
    write_json(run.path(SPEED), speed._asdict())


def known_speed(run: Run) -> Speed | None:
    """Read the speed that ``keep_speed`` stored last; `None` if it stored none, or another version did."""
    file = run.path(SPEED)
    stored = read_json(file) if file.exists() else {}
    return Speed(**stored) if stored.keys() == set(Speed._fields) else None


def record(run: Run, trial: Mapping[str, str]) -> None:
    """Record this machine's trial, unless the run was begun on a machine with another result.

    Raises:
        PipelineError: as ``reject_another``.
    """
    reject_another(run, trial)
    here = {**made_with("encoding"), "OpenGL device": trial["OpenGL device"]}
    write_json(run.path(MACHINE), {"made with": here, "trials": trials(run) | _named(trial)})


def reject_another(run: Run, trial: Mapping[str, str]) -> None:
    """Compare a trial with the recorded ones; nothing is written.

    Raises:
        PipelineError: when another machine with the same versions and device had another result and generated files.
            They would count as up to date, so the run would mix two results.
    """
    recorded = trials(run)
    for name, digest in _named(trial).items():
        stores = STORES[name.split(",")[0]]
        files_exist = any(next(run.path(store).rglob(f"*{SUFFIX}"), None) for store in stores)
        if recorded.get(name, digest) != digest and files_exist:
            raise PipelineError(
                f"the trial ({name}) gave {recorded[name]} on the machine that began the run, and gives {digest} here",
                where=run.path(MACHINE),
                expected="equal results of equal versions on the same OpenGL device",
                remedy="resume on the machine that began the run, or move the folders "
                f"{' and '.join(stores)} to another place",
            )


def trials(run: Run) -> dict[str, str]:
    """Map the names of the recorded trials of a run to their digests; empty without a record of this version."""
    file = run.path(MACHINE)
    return dict(read_json(file).get("trials", {})) if file.exists() else {}


def _named(trial: Mapping[str, str]) -> dict[str, str]:
    return {
        f"ten steps, made by {fingerprint('physics')}": trial["ten steps"],
        f"one frame, made by {fingerprint('pixels', trial['OpenGL device'])}": trial["one frame"],
    }
