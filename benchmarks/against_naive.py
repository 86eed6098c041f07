"""Replay and rendering of a configuration's episodes: our stages, and one LIBERO environment for each episode.

    nice -n 10 python benchmarks/against_naive.py [--config configs/starter.yaml] [--tasks 'libero_goal/put_the_bowl_*']

The script takes one demonstration of the starter set for each task, and the configuration's number of episodes for each
demonstration. Our side replays and renders as the stages do, failed replays included. The naive side opens LIBERO's
own environment for every kept episode and changes its model in the same way. It steps the same actions with both
cameras and encodes the frames. Both sides run in this process and on one core. The last line is JSON: CPU seconds of
both sides, and the number of frames with equal bytes.
"""

import argparse
import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np
from episode_slice import sliced
from libero_environment import OffScreenRenderEnv

from pipeline.axes import PixelPerturbation, RenderPerturbation, from_json, of_layer
from pipeline.compute.pool import loop
from pipeline.config import Config, load
from pipeline.episode_schema import SCHEMA, STANDARD
from pipeline.images.jpeg import encode, to_policy
from pipeline.libero.tasks import find_task, select_tasks
from pipeline.machine_code import MACHINE_CODE_VARIABLES, ensure_fixed_machine_code
from pipeline.physics.environment import DUMMY_ACTION
from pipeline.planning import plan, selection
from pipeline.planning.streams import streams_of
from pipeline.run.progress import rejections
from pipeline.run.render_stage import render_plan
from pipeline.run.replay_stage import Replays
from pipeline.stores.frame_store import FrameStore, frames_by_trajectory
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.testset import benchmark
from pipeline.types import Trajectory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--config", type=Path, default=Path("configs/starter.yaml"))
    parser.add_argument("--tasks", nargs="+", help="tasks; by default those of the configuration")
    arguments = parser.parse_args()
    config = sliced(load(arguments.config), arguments.tasks)
    rows = plan.make(config.demos.index().entries, config.plan, config.replay, benchmark.load())
    with TemporaryDirectory() as temporary:
        trajectories, frames = Path(temporary) / "trajectories", Path(temporary) / "frames"
        begun = time.process_time()
        verdicts = Replays(config.demos, config.replay, TrajectoryStore(trajectories), loop, config.filter).complete(
            rows
        )
        replayed = time.process_time()
        render_plan(rows, config, TrajectoryStore(trajectories), FrameStore(frames, config.render), loop)
        rendered = time.process_time()
        store = FrameStore(frames, config.render)
        outcome = selection.select(rows, verdicts, rejections(rows, frames_by_trajectory(store.rows()), STANDARD.views))
        kept = [row for row in rows if outcome[row.episode_id].kept]
        naive_s, same, count = 0.0, 0, 0
        for row in kept:
            trajectory = TrajectoryStore(trajectories).load(row.trajectory_id)
            start = time.process_time()
            theirs = naive(row, trajectory, config)
            took_s = time.process_time() - start
            naive_s += took_s
            streams = streams_of(row.perturbations)
            stream_ids = [stream.stream_id for stream in streams.values()]
            ours = store.load(row.trajectory_id, stream_ids, set()).streams
            pairs: list[tuple[bytes, bytes]] = []
            for view, stream in streams.items():
                pairs += zip(ours[stream.stream_id], theirs[view], strict=True)
            equal = sum(our_frame == naive_frame for our_frame, naive_frame in pairs)
            same, count = same + equal, count + len(pairs)
            print(f"{row.task} {row.axis}: naive {took_s:.0f} s, {equal} of {len(pairs)} frames equal", flush=True)
    print(
        json.dumps(
            {
                "config": str(arguments.config),
                "tasks": len(select_tasks(config.demos.tasks)),
                "episodes": len(kept),
                "frames": count,
                "same_frames": same,
                "replay_s": round(replayed - begun, 1),
                "render_s": round(rendered - replayed, 1),
                "naive_s": round(naive_s, 1),
                "naive_against_ours": round(naive_s / (rendered - begun), 2),
            }
        )
    )


def naive(row: plan.Row, trajectory: Trajectory, config: Config) -> dict[str, list[bytes]]:
    """Render an episode in an environment of its own; return view to the encoded frames before each action."""
    height, width, _ = SCHEMA.frame.shape
    task = find_task(row.suite, row.task)
    env = OffScreenRenderEnv(bddl_file_name=str(task.bddl_file), camera_heights=height, camera_widths=width)
    env.reset()
    env.reset_from_xml_string(trajectory.model_xml)
    model, perturbations = env.sim.model._model, from_json(row.perturbations)
    textures = model.tex_data.copy()
    for change in of_layer(perturbations, RenderPerturbation):
        change.apply(model)
    context = env.sim._render_context_offscreen
    context.gl_ctx.make_current()
    if not (textures == model.tex_data).all():
        for texture in range(model.ntex):
            mujoco.mjr_uploadTexture(model, context.con, texture)
    # LIBERO itself renders its observations a substep before the final state of a step.
    for spec in SCHEMA.views.values():
        env.env.modify_observable(f"{spec.camera}_image", "enabled", False)
    # A replay restores more than the state, see pipeline/physics/environment.py.
    robot, scene = env.env.robots[0], trajectory.scene
    robot.gripper.current_action = scene.start.gripper * np.array([-1.0, 1.0])
    env.sim.reset()
    # MuJoCo begins its search for the contact forces at the last ones, so they are computed as often as in a replay.
    env.sim.set_state_from_flattened(scene.state)
    if scene.start.posture_rad is not None:
        env.sim.data.qpos[robot._ref_joint_pos_indexes] = scene.start.posture_rad
        env.sim.data.qvel[robot._ref_joint_vel_indexes] = 0.0
    env.sim.forward()
    robot.controller.update_initial_joints(env.sim.data.qpos[robot._ref_joint_pos_indexes])
    if scene.start.posture_rad is not None:
        env.set_init_state(scene.state)
    for _ in range(config.replay.settle_steps):
        env.step(DUMMY_ACTION)
    frames: dict[str, list[bytes]] = {view: [] for view in SCHEMA.views}
    for step, action in enumerate(trajectory.actions):
        # A step ends with integrated positions; bodies and cameras are a substep behind.
        mujoco.mj_kinematics(model, env.sim.data._data)
        mujoco.mj_camlight(model, env.sim.data._data)
        for view, spec in SCHEMA.views.items():
            frame = env.sim.render(width=width, height=height, camera_name=spec.camera)
            for noise in of_layer(perturbations, PixelPerturbation):
                if view in noise.views:
                    frame = noise.apply(frame, step)
            frames[view].append(encode(to_policy(frame), config.render.jpeg_quality))
        env.step(action)
    env.close()
    return frames


if __name__ == "__main__":
    one_thread = {"LP_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    ensure_fixed_machine_code(MACHINE_CODE_VARIABLES | one_thread)
    main()
