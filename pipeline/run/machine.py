"""Whether this machine still computes what it, or another, computed for a run: versions alone do not say that.

Ten control steps and a frame are tried. Their digests are recorded with what they were made with, and a run that has
files goes on only where the same versions and the same device give the same digests.
"""

import hashlib
import time
import timeit
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import NamedTuple

from pipeline import gl
from pipeline.config import ReplayConfig
from pipeline.errors import PipelineError
from pipeline.files import read_json, write_json
from pipeline.identity import fingerprint, made_with
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.run.run import FINISHED, FRAMES, MACHINE, TRAJECTORIES, Run
from pipeline.stores.store import SUFFIX

SPEED = f"{FINISHED}/speed.json"
"""File of a run's folder that says how fast the machine was, by which ``status`` knows the time that is left."""

STORES = {"ten steps": (TRAJECTORIES, FRAMES), "one frame": (FRAMES,)}
"""What of a trial stands for the files of which folders."""

TRIAL_TASK, TRIAL_STEPS = ("libero_goal", "turn_on_the_stove"), 10
"""What is simulated and rendered to see whether this machine still gives the same numbers and the same picture."""


class Speed(NamedTuple):
    """How fast this machine is: seconds of one core for a control step, and for a frame of the trial's scene by the
    plain renderer: of the core, or of one of so many GPUs."""

    step_s: float
    frame_s: float
    gpus: int = 0


class Trial(NamedTuple):
    """What a trial came to.

    Attributes:
        digests: of ten control steps and of a frame of their end, and the device that rendered it.
        speed: of this machine.
    """

    digests: Mapping[str, str]
    speed: Speed


@cache
def trial() -> Trial:
    """Simulate and render a little, in some five seconds."""
    from pipeline.physics.environment import Environment
    from pipeline.physics.replay import replay
    from pipeline.rendering.drawing import PlainDrawing
    from pipeline.rendering.renderer import Renderer

    demo = StarterSource().of(find_task(*TRIAL_TASK))
    environment = Environment(demo.task)
    short = replace(demo, actions=demo.actions[:TRIAL_STEPS])
    trajectory = replay(environment, short, "trial", ReplayConfig(mode="open_loop", noops="keep"))
    step_s = _seconds(lambda: environment.step(demo.actions[TRIAL_STEPS]))
    environment.close()
    renderer = Renderer(trajectory.model_xml)
    renderer.restore(trajectory.states[-1], trajectory.site_alpha[-1])
    frame = renderer.frame("agentview")
    renderer.close()
    plain = Renderer(renderer.model, PlainDrawing(renderer.model))
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
    """Of the quickest of ten calls: of the processor, so that other work counts little, or on the clock for a GPU."""
    return min(timeit.repeat(call, number=1, repeat=10, timer=time.perf_counter if gpu else time.process_time))


def keep_speed(run: Run, speed: Speed) -> None:
    """Write it down for ``status``; no file that is made depends on it."""
    run.path(SPEED).parent.mkdir(exist_ok=True)
    write_json(run.path(SPEED), speed._asdict())


def known_speed(run: Run) -> Speed | None:
    """What ``keep_speed`` wrote last; None where it did not, or another version did."""
    file = run.path(SPEED)
    found = read_json(file) if file.exists() else {}
    return Speed(**found) if found.keys() == set(Speed._fields) else None


def record(run: Run, trial: Mapping[str, str]) -> None:
    """Write what is here, unless the run was begun where the trial came to something else.

    Raises:
        PipelineError: as ``refuse_another``.
    """
    refuse_another(run, trial)
    here = {**made_with("encoding"), "OpenGL device": trial["OpenGL device"]}
    write_json(run.path(MACHINE), {"made with": here, "trials": trials(run) | _named(trial)})


def refuse_another(run: Run, trial: Mapping[str, str]) -> None:
    """Compare a trial with those that are recorded; nothing is written.

    Raises:
        PipelineError: when another machine with the same versions and device came to something else, and files were
            made. They would count as current, so that the run would be of two kinds.
    """
    recorded = trials(run)
    for name, digest in _named(trial).items():
        stores = STORES[name.split(",")[0]]
        files_exist = any(next(run.path(store).rglob(f"*{SUFFIX}"), None) for store in stores)
        if recorded.get(name, digest) != digest and files_exist:
            raise PipelineError(
                f"the run was begun where {name} came to {recorded[name]}, here it is {digest}",
                where=run.path(MACHINE),
                expected="the same results of the same versions on the same OpenGL device",
                remedy="go on where it was begun, or move away its " + " and its ".join(stores),
            )


def trials(run: Run) -> dict[str, str]:
    """What the run's folder has, by name; none where there is no record, or one of an earlier version."""
    file = run.path(MACHINE)
    return dict(read_json(file).get("trials", {})) if file.exists() else {}


def _named(trial: Mapping[str, str]) -> dict[str, str]:
    return {
        f"ten steps, made by {fingerprint('physics')}": trial["ten steps"],
        f"one frame, made by {fingerprint('pixels', trial['OpenGL device'])}": trial["one frame"],
    }
