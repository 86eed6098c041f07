"""Measures of a GPU's rendering: frames per second of 1 to 16 processes by each kind of rendering, and their pixels.

    python benchmarks/gpu.py --pack FOLDER
    python benchmarks/gpu.py FOLDER [--seconds 3] [--processes 1 4 8 16] [--drawings plain layers ...] [--states 12]

The first call replays one demonstration of each task of ``TASKS``, and packs the scenes with their meshes and images.
The second call needs no LIBERO and no robosuite. It compares the frames of each kind with plain frames of the same
device, in all scenes, with and without shadows. Then some processes render the states of the first scene with both
cameras, JPEG included, each process in its own context, with the environment of a run's workers. A last round for each
kind measures the time that parts of the work take.

The last line is JSON with the device, the kinds that a run with 1 worker and with the largest number would use, and for
each kind:

- the number of compared frames, of frames with other pixels, and the largest difference in grey levels;
- for each number of processes: frames per second, CPU time of a frame, peak memory, the GPU's load by ``nvidia-smi``;
- for one process and the largest number: the milliseconds of a frame by part, on the clock, and the GPU's own time.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import re
import resource
import shutil
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from itertools import product
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np

from pipeline import gl
from pipeline.compute.workers import VARIABLES
from pipeline.config import RenderConfig
from pipeline.images.jpeg import encode, to_policy
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.rendering.model_renderer import ModelRenderer
from pipeline.rendering.opengl import calls
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.rendering.savings import create_model_renderer, why_plain
from pipeline.rendering.software.in_flight import InFlightRenderer
from pipeline.rendering.software.layers import LayeredRenderer
from pipeline.rendering.software.software_renderer import SoftwareRenderer
from pipeline.types import Frame, State

CAMERAS = ("agentview", "robot0_eye_in_hand")

TASKS = {
    "tabletop": "libero_goal/put_the_bowl_on_the_plate",
    "study": "libero_10/STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy",
}
"""Packed scenes; frames per second are of the first scene, as in former measurements."""

Frames = np.ndarray[Any, np.dtype[np.uint8]]

_FILE = re.compile(r'\sfile\w*="')
"""Beginning of an attribute that names a file."""

KINDS: dict[str, type[ModelRenderer]] = {
    "plain": PlainRenderer,
    "plain, 2 in flight": InFlightRenderer,
    "layers": LayeredRenderer,
    "savings": SoftwareRenderer,
}


@dataclass(frozen=True)
class Scene:
    """A packed scene.

    Attributes:
        model: compiled model.
        states: (T, S) states of a trajectory.
        site_alpha: (T, nsite) opacity of the sites in each state.
    """

    model: mujoco.MjModel
    states: np.ndarray[Any, np.dtype[np.float64]]
    site_alpha: np.ndarray[Any, np.dtype[np.float32]]

    @staticmethod
    def load(folder: Path, name: str) -> Scene:
        # MuJoCo looks up absolute paths as they are.
        scene = _FILE.sub(rf"\g<0>{folder.resolve()}/", (folder / f"{name}.xml").read_text())
        model = mujoco.MjModel.from_xml_string(scene)
        with np.load(folder / f"{name}.npz") as arrays:
            return Scene(model, arrays["states"], arrays["site_alpha"])

    def restore(self, data: mujoco.MjData, step: int) -> None:
        State.of(self.states[step], self.model.nq).put_into(data)
        self.model.site_rgba[:, 3] = self.site_alpha[step]
        mujoco.mj_forward(self.model, data)


@dataclass
class Work:
    """Work of one process: frames in the seconds, CPU seconds, peak memory, and seconds by part of the work."""

    frames: int = 0
    seconds: float = 0.0
    cpu_s: float = 0.0
    peak_gb: float = 0.0
    parts_s: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Pixels:
    """Comparison with plain frames: frames, frames with other pixels, and the largest difference in grey levels."""

    frames: int
    other: int
    most_levels: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, help="packed scenes")
    parser.add_argument("--pack", action="store_true", help="write the folder")
    parser.add_argument("--seconds", type=float, default=3)
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 4, 8, 16])
    parser.add_argument("--drawings", nargs="+", default=list(KINDS), choices=list(KINDS), metavar="NAME")
    parser.add_argument(
        "--states", type=int, default=12, help="number of states of each scene in which pixels are compared"
    )
    arguments = parser.parse_args()
    if arguments.pack:
        pack(arguments.folder)
        return
    choice = gl.choose()
    print(choice, flush=True)
    names, most = arguments.drawings, max(arguments.processes)
    figures: dict[str, dict[str, Any]] = {name: {} for name in names}
    chosen: dict[int, Any] = {}
    with pool(1, arguments.folder) as workers:
        chosen[1] = asked(workers, [("choose",)])[0]
    with pool(min(most, len(names)), arguments.folder) as workers:
        for name, pixels in zip(names, compared(workers, names, arguments.states), strict=True):
            figures[name]["pixels"] = pixels
            print(name, pixels, flush=True)
    with pool(most, arguments.folder) as workers:
        chosen[most] = asked(workers[:1], [("choose",)])[0]
        print(chosen, flush=True)
        for name in names:
            fault = opened(workers, name)
            if fault:
                figures[name]["fault"] = fault
                print(name, fault, flush=True)
                continue
            for count in arguments.processes:
                measured = rendered(workers[:count], arguments.seconds)
                figures[name][f"{count} processes"] = measured
                print(name, count, measured, flush=True)
            for count in (1, most):
                parts = profiled(workers[:count], arguments.seconds / 2)
                figures[name][f"ms a frame of {count}"] = parts
                print(name, count, parts, flush=True)
    print(json.dumps({"device": choice.device, "cores": os.cpu_count(), "chosen": chosen, "drawings": figures}))


def pack(folder: Path) -> None:
    """Replay a demonstration of each task, and write its scene, the files of the scene and its states to a folder."""
    from replayed_twin import replayed_twin

    from pipeline.catalogue.scene_files import portable
    from pipeline.config import load
    from pipeline.libero.assets import installed

    folder.mkdir(parents=True, exist_ok=True)
    for name, task in TASKS.items():
        with TemporaryDirectory() as temporary:
            trajectory = replayed_twin(load(Path("configs/starter.yaml")), task, Path(temporary))
        scene = portable(trajectory.model_xml)
        for file in set(re.findall(r'\sfile\w*="([^"]*)"', scene)):
            target = folder / file
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(installed(file), target)
        (folder / f"{name}.xml").write_text(scene)
        np.savez_compressed(folder / f"{name}.npz", states=trajectory.states, site_alpha=trajectory.site_alpha)


@contextmanager
def pool(count: int, folder: Path) -> Iterator[list[Connection]]:
    """Start processes like a run's workers, and yield a connection to each when all have the first scene."""
    context, setup = multiprocessing.get_context("spawn"), gl.WorkerSetup(count)
    connections, processes = [], []
    os.environ.update(VARIABLES)
    for number in range(count):
        connection, of_worker = context.Pipe()
        process = context.Process(target=serve, args=(of_worker, setup, number, folder), daemon=True)
        process.start()
        # Without this end here, waiting for a process that died raises an error.
        of_worker.close()
        connections.append(connection)
        processes.append(process)
    try:
        for connection in connections:
            connection.recv()
        yield connections
    finally:
        for connection in connections:
            with suppress(OSError):
                connection.send(None)
        for process in processes:
            process.join(20)
            process.kill()


def asked(workers: Sequence[Connection], questions: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Send each worker its question, and return the answers; the answer of a failed worker is a text."""
    answers: list[Any] = []
    for worker, question in zip(workers, questions, strict=True):
        with suppress(OSError):
            worker.send(question)
    for worker in workers:
        try:
            answers.append(worker.recv())
        except (EOFError, OSError):
            answers.append("the process has ended")
    return answers


def fault_of(answers: Sequence[Any]) -> str | None:
    """Return the first error among answers; errors are texts."""
    return next((answer for answer in answers if isinstance(answer, str)), None)


def compared(workers: Sequence[Connection], names: Sequence[str], states: int) -> list[Any]:
    """Return the comparison with plain frames for each kind of rendering, or an error."""
    answers: list[Any] = []
    for first in range(0, len(names), len(workers)):
        some = names[first : first + len(workers)]
        answers += asked(workers[: len(some)], [("compare", name, states) for name in some])
    return answers


def opened(workers: Sequence[Connection], name: str) -> str | None:
    """Create a ``ModelRenderer`` of a kind in all workers, and return an error if there is one."""
    return fault_of(asked(workers, [("open", name)] * len(workers)))


def rendered(workers: Sequence[Connection], seconds: float) -> dict[str, Any]:
    """Measure some workers with an open ``ModelRenderer`` at the same time."""
    with gpu_load() as loads:
        done = asked(workers, [("render", seconds)] * len(workers))
    fault = fault_of(done)
    if fault:
        return {"fault": fault}
    frames = sum(work.frames for work in done)
    return {
        "frames_per_s": round(sum(work.frames / work.seconds for work in done), 1),
        "cpu_ms": round(1000 * sum(work.cpu_s for work in done) / frames, 2),
        "peak_gb": round(max(work.peak_gb for work in done), 2),
        **({"gpu_load": round(float(np.mean(loads)))} if loads else {}),
    }


def profiled(workers: Sequence[Connection], seconds: float) -> dict[str, Any]:
    """Return the milliseconds of a frame by part of the work, the mean of workers with an open ``ModelRenderer``."""
    done = asked(workers, [("profile", seconds)] * len(workers))
    fault = fault_of(done)
    if fault:
        return {"fault": fault}
    frames = sum(work.frames for work in done)
    parts = {part: sum(work.parts_s[part] for work in done) for part in done[0].parts_s}
    return {part: round(1000 * spent_s / frames, 3) for part, spent_s in parts.items()}


@contextmanager
def gpu_load() -> Iterator[list[float]]:
    """Yield a list that has the GPU's load in percent, several times a second, at the end; empty without nvidia-smi."""
    loads: list[float] = []
    if shutil.which("nvidia-smi") is None:
        yield loads
        return
    command = ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits", "-lms", "250"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            yield loads
        finally:
            process.terminate()
            lines = process.communicate()[0].splitlines()
            loads += [float(line) for line in lines if line.strip().isdigit()]


def serve(connection: Connection, setup: gl.WorkerSetup, number: int, folder: Path) -> None:
    """Answer the questions of the main process until it sends `None`."""
    setup(number)
    scene = Scene.load(folder, next(iter(TASKS)))
    connection.send(None)
    renderer: ModelRenderer | None = None
    for question in iter(connection.recv, None):
        subject, *arguments = question
        if renderer and subject not in ("render", "profile"):
            renderer.close()
            renderer = None
        answer: Any = None
        try:
            if subject == "choose":
                renderer = create_model_renderer(scene.model)
                answer = {"drawing": type(renderer).__name__, "why plain": why_plain()}
            elif subject == "open":
                renderer = KINDS[arguments[0]](scene.model)
                render(scene, renderer, 0.3)
            elif subject == "compare":
                answer = asdict(compare(folder, *arguments))
            elif renderer and subject == "render":
                answer = render(scene, renderer, *arguments)
            elif renderer:
                answer = profile(scene, renderer, *arguments)
        except Exception as error:  # drivers fail in many ways, and each is an answer here
            answer = f"{type(error).__name__}: {error}"
        connection.send(answer)
    if renderer:
        renderer.close()


def render(scene: Scene, renderer: ModelRenderer, seconds: float) -> Work:
    """Render and encode the scene's states in turn for some seconds, with both cameras."""
    work, data = Work(parts_s=dict.fromkeys(("restore", "start", "wait", "encode"), 0.0)), mujoco.MjData(scene.model)
    waiting: deque[Callable[[], Frame]] = deque()
    jpeg_quality = RenderConfig().jpeg_quality

    def timed(part: str, function: Callable[..., Any], *arguments: Any) -> Any:
        began = time.perf_counter()
        result = function(*arguments)
        work.parts_s[part] += time.perf_counter() - began
        return result

    def finish() -> None:
        frame = timed("wait", waiting.popleft())
        timed("encode", lambda: encode(to_policy(frame), jpeg_quality))
        work.frames += 1

    start, start_cpu, step = time.perf_counter(), time.process_time(), 0
    while time.perf_counter() - start < seconds:
        timed("restore", scene.restore, data, step)
        step = (step + 1) % (len(scene.states) - 1)
        for camera in CAMERAS:
            waiting.append(timed("start", renderer.start_frame, data, camera))
            while len(waiting) > renderer.steps_ahead * len(CAMERAS):
                finish()
    while waiting:
        finish()
    work.seconds, work.cpu_s = time.perf_counter() - start, time.process_time() - start_cpu
    work.peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return work


def profile(scene: Scene, renderer: ModelRenderer, seconds: float) -> Work:
    """Render like ``render``, and measure the calls of MuJoCo and the GPU's time for its pictures too."""
    spent_s: dict[str, float] = {}
    queries: list[int] = []
    functions = {name: getattr(mujoco, name) for name in ("mjv_updateScene", "mjr_render", "mjr_readPixels")}

    def measured(name: str) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            began = time.perf_counter()
            result = functions[name](*arguments)
            spent_s[name] = spent_s.get(name, 0.0) + time.perf_counter() - began
            return result

        return call

    calls_of_mujoco = {name: measured(name) for name in functions}

    def on_gpu(*arguments: Any) -> None:
        opengl = calls()
        queries.append(int(np.atleast_1d(opengl.glGenQueries(1))[0]))
        opengl.glBeginQuery(opengl.GL_TIME_ELAPSED, queries[-1])
        calls_of_mujoco["mjr_render"](*arguments)
        opengl.glEndQuery(opengl.GL_TIME_ELAPSED)

    for name, call in (calls_of_mujoco | {"mjr_render": on_gpu}).items():
        setattr(mujoco, name, call)
    try:
        work = render(scene, renderer, seconds)
    finally:
        for name, function in functions.items():
            setattr(mujoco, name, function)
    opengl = calls()
    gpu_ns = [int(np.ravel(opengl.glGetQueryObjectuiv(query, opengl.GL_QUERY_RESULT))[0]) for query in queries]
    opengl.glDeleteQueries(len(queries), queries)
    work.parts_s |= spent_s | {"GPU": sum(gpu_ns) / 1e9, "all": work.seconds}
    return work


def compare(folder: Path, name: str, states: int) -> Pixels:
    """Compare the frames of a kind of rendering with plain frames, in all scenes, with and without shadows."""
    frames = other = most_levels = 0
    plain_frames = list(frames_of_scenes(folder, PlainRenderer, states))
    for plain, ours in zip(plain_frames, frames_of_scenes(folder, KINDS[name], states), strict=True):
        levels = np.abs(ours.astype(int) - plain).reshape(len(plain), -1).max(axis=1)
        frames, other = frames + len(levels), other + int(np.count_nonzero(levels))
        most_levels = max(most_levels, int(levels.max()))
    return Pixels(frames, other, most_levels)


def frames_of_scenes(folder: Path, kind: type[ModelRenderer], states: int) -> Iterator[Frames]:
    """Yield the frames of each scene, without and with shadows; following scenes share a context if possible."""
    with ExitStack() as opened:
        renderer: ModelRenderer | None = None
        for task, shadows in product(TASKS, (False, True)):
            scene = Scene.load(folder, task)
            scene.model.light_castshadow[:] |= shadows
            if renderer is None or not renderer.adopt(scene.model):
                opened.close()
                renderer = opened.enter_context(closing(kind(scene.model)))
            yield frames_of(scene, renderer, states)


def frames_of(scene: Scene, renderer: ModelRenderer, states: int) -> Frames:
    """Render some states, from the first to the last, with both cameras, (N, H, W, 3)."""
    data = mujoco.MjData(scene.model)
    waiting: list[Callable[[], Frame]] = []
    for step in np.linspace(0, len(scene.states) - 1, states).round().astype(int).tolist():
        scene.restore(data, step)
        waiting += [renderer.start_frame(data, camera) for camera in CAMERAS]
    return np.stack([wait() for wait in waiting])


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
