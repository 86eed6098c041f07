"""New axis, tried on a scene of a run: python examples/add_axis.py data/starter

Configurations can name the axis after two changes: put both classes into a file of ``pipeline/axes``, and add a line to
its ``__init__.py``. CONTRIBUTING.md has the steps.
"""

import argparse
from pathlib import Path
from typing import ClassVar, Literal

import mujoco
import numpy as np

from pipeline import seeding
from pipeline.axes.base import Axis, RenderPerturbation
from pipeline.libero.tasks import find_task
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.rendering.renderer import Renderer
from pipeline.run import manifest
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.types import Task


class LensPerturbation(RenderPerturbation):
    """Changed field of view of the agent camera."""

    axis: Literal["lens"] = "lens"
    component: Literal["zoom"] = "zoom"
    fovy_scale: float  # multiple of the scene's vertical field of view

    views: ClassVar[frozenset[str]] = frozenset({"image"})
    fields: ClassVar[tuple[str, ...]] = ("cam_fovy",)

    def apply(self, model: mujoco.MjModel) -> None:
        model.cam_fovy[model.camera("agentview").id] *= self.fovy_scale


class LensAxis(Axis):
    """Axis that narrows the view by up to 6 % at level 1 and up to 30 % at level 5."""

    kinds: ClassVar = (LensPerturbation,)

    def sample(self, rng: np.random.Generator, task: Task, entry_index: int) -> LensPerturbation:
        level = self.sample_level(rng)
        return LensPerturbation(level=level, fovy_scale=round(1 - 0.06 * (level - rng.random()), 4))


def main(run: Path) -> None:
    row = next(row for row in manifest.read(run / "manifest.parquet") if row["kept"])
    task = find_task(row["suite"], row["task"])
    trajectory = TrajectoryStore(run / "trajectories").load(row["trajectory_id"])
    renderer = Renderer(trajectory.model_xml)
    renderer.restore(trajectory.states[0], trajectory.site_alpha[0])
    before = renderer.frame("agentview").astype(int)
    for variant in range(3):
        lens = LensAxis().sample(seeding.rng(7, "lens", row["demo_id"], variant), task, variant)
        with renderer.perturbed([lens]):
            after = renderer.frame("agentview")
        print(f"{lens.model_dump_json()}: frames differ by {np.abs(after - before).mean():.1f} grey levels")
    renderer.close()


if __name__ == "__main__":
    ensure_fixed_machine_code()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    main(parser.parse_args().run)
