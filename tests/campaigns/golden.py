"""Recorded results of a few short real episodes; `python tests/campaigns/golden.py` adds missing results.

Recorded results are never overwritten. If a result has changed, raise the number in the same commit and run this script
again: in ``pipeline.identity.RECIPES``, or in the class of the format. The new number generates every stored file of
the step or format again.
"""

import hashlib
import json
import os
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

if __name__ == "__main__":  # run as a script, from anywhere
    sys.path[:0] = [os.fspath(folder) for folder in Path(__file__).parents[1:3]]

import numpy as np

from pipeline import gl, identity
from pipeline.axes import PhysicsPerturbation, PixelPerturbation, RenderPerturbation, from_json, of_layer
from pipeline.config import RenderConfig, ReplayConfig
from pipeline.formats.registry import FORMATS
from pipeline.images.jpeg import encode
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.physics.environment import Environment
from pipeline.physics.reference import Reference
from pipeline.physics.replay import replay
from pipeline.rendering.renderer import Renderer
from pipeline.types import Floats, Frame, Trajectory

FILE = Path(__file__).with_name("golden.json")
STEPS = 25
"""Recorded steps of a trajectory; later, contacts magnify differences between two processors."""
DECIMALS = 6
CELLS = 8
"""Thumbnails are CELLS x CELLS means, which any renderer must reproduce to about a grey level."""


@dataclass
class Golden:
    """Current results of the recorded cases on this machine."""

    cases: dict[str, str]

    @cached_property
    def trajectories(self) -> dict[str, Trajectory]:
        """Return case to replay, for the clean case and all cases that change physics."""
        task = find_task("libero_goal", "put_the_bowl_on_the_plate")
        demo = StarterSource().demonstration(task)
        environment = Environment(task)
        clean = replay(environment, demo, "clean", ReplayConfig())
        reference = Reference.of(clean.model_xml, clean.states, clean.actions)
        replays = {"clean": clean}
        for case, listed in self.cases.items():
            physics = of_layer(from_json(listed), PhysicsPerturbation)
            if physics:
                config = ReplayConfig(mode="tracked" if case == "robot" else "open_loop")
                replays[case] = replay(environment, demo, case, config, physics, lambda: reference)
        environment.close()
        rejected = [case for case, trajectory in replays.items() if not len(trajectory.actions)]
        if rejected:
            raise ValueError(f"rejected in this scene, so they show nothing: {rejected}")
        return replays

    @cached_property
    def frames(self) -> dict[str, Frame]:
        """Return ``<case> <camera>`` to the first frame."""
        frames: dict[str, Frame] = {}
        trajectories = {case: self.trajectories.get(case, self.trajectories["clean"]) for case in self.cases}
        # An open scene takes half a gigabyte and two seconds: each is opened once, and closed before the next.
        for model_xml in dict.fromkeys(trajectory.model_xml for trajectory in trajectories.values()):
            renderer = Renderer(model_xml)
            for case, trajectory in trajectories.items():
                if trajectory.model_xml == model_xml:
                    frames |= _first_frames(renderer, trajectory, case, self.cases[case])
            renderer.close()
            del renderer
        return frames

    def physics(self) -> dict[str, str]:
        return {case: _digest(trajectory) for case, trajectory in self.trajectories.items()}

    def pixels(self) -> dict[str, str]:
        return {name: hashlib.sha256(frame.tobytes()).hexdigest()[:16] for name, frame in self.frames.items()}

    def thumbnails(self) -> dict[str, list[list[float]]]:
        return {name: np.round(thumbnail(frame), 1).tolist() for name, frame in self.frames.items()}

    def encoding(self) -> str:
        """Return the digest of an encoded synthetic picture."""
        rows, columns = np.mgrid[0:256, 0:256]
        picture = np.stack([rows, columns, rows ^ columns], axis=-1).astype(np.uint8)
        return hashlib.sha256(encode(picture, RenderConfig().jpeg_quality)).hexdigest()[:16]


def _first_frames(renderer: Renderer, trajectory: Trajectory, case: str, listed: str) -> dict[str, Frame]:
    """Render ``<case> <camera>`` to the first frame, with the perturbations in ``listed``, a JSON text."""
    perturbations = from_json(listed)
    frames: dict[str, Frame] = {}
    with renderer.perturbed(of_layer(perturbations, RenderPerturbation)):
        renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
        for camera in ("agentview", "robot0_eye_in_hand"):
            frame = renderer.frame(camera)
            for noise in of_layer(perturbations, PixelPerturbation):
                frame = noise.apply(frame, 0)
            frames[f"{case} {camera}"] = frame
    return frames


def thumbnail(frame: Frame) -> Floats:
    """Return the mean grey levels of a frame's cells (CELLS, CELLS)."""
    height, width, _ = frame.shape
    cells: Floats = frame.reshape(CELLS, height // CELLS, CELLS, width // CELLS, 3).mean(axis=(1, 3, 4))
    return cells


def _digest(trajectory: Trajectory) -> str:
    # Adding zero turns a rounded -0.0 into 0.0.
    rounded = np.round(
        np.concatenate([trajectory.states[:STEPS].ravel(), trajectory.actions[:STEPS].ravel()]), DECIMALS
    )
    return hashlib.sha256((rounded + 0.0).tobytes()).hexdigest()[:16]


def recorded() -> dict[str, Any]:
    """Read the file: cases, and for each step its recipe number to the results."""
    content: dict[str, Any] = json.loads(FILE.read_text())
    return content


def recipes() -> dict[str, int]:
    """Map each step and each format to its recipe number."""
    steps: dict[str, int] = dict(identity.RECIPES.items())
    return steps | {kind.name: kind.recipe for kind in FORMATS}


def main() -> None:
    import golden_stages  # here, as it needs no renderer and imports many modules

    gl.choose()
    content = recorded()
    golden, device = Golden(content["cases"]), gl.choose().device
    number = {step: str(recipe) for step, recipe in recipes().items()}
    pixels = content["pixels"].setdefault(number["pixels"], {"thumbnails": golden.thumbnails(), "devices": {}})
    for results, key, result, layer in (
        (content["physics"], number["physics"], golden.physics(), "physics"),
        (pixels["devices"], device, golden.pixels(), "pixels"),
        (content["encoding"], number["encoding"], golden.encoding(), "encoding"),
        *((content.setdefault(step, {}), number[step], make(), step) for step, make in golden_stages.STEPS.items()),
    ):
        if results.setdefault(key, result) != result:
            sys.exit(f"{layer} has changed and its recipe number has not: raise it")
    FILE.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
