"""OpenVLA-OFT is given the run's datasets, recipe and schedule, in a stand-in for its checkout.

It cannot be installed here. The stand-in has the names that the script touches, and a training script that writes down
what it was given.
"""

import argparse
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from short_runs import datasets_in
from tiny_recipe import NAME, SUITES, export_config, row, tiny_recipe

from pipeline.clients.recipe import write
from pipeline.clients.templates.run_openvla_oft import condition, join_conditions


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's data folder with what the recipe stage writes."""
    data = tmp_path_factory.mktemp("data")
    write(tiny_recipe(data), data / "finetune", export_config(), datasets_in(data))
    return data


def ended(folder: Path, script: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a client's script in a stand-in checkout."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "HOME": str(folder / "home")}
    command = [sys.executable, str(script), *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def run(folder: Path, script: Path, *arguments: str) -> dict[str, Any]:
    """The same; returns what its training script wrote down."""
    done = ended(folder, script, *arguments)
    assert done.returncode == 0, done.stderr
    seen: dict[str, Any] = json.loads((folder / "seen.json").read_text())
    return seen


def stand_in(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


EPISODES = {
    "episode_id": ["clean", "weak", "strong", "joint", "stronger", "noise"],
    "axis": ["clean", "camera", "camera", "camera+noise", "camera+noise", "noise"],
    "component": ["none", "distance", "distance", "distance+gauss", "spherical+gauss", "gauss"],
    "level": ["0", "1", "3", "2+1", "2+4", "1"],
}
"""Labels of six episodes."""

OFT_DATA = "prismatic/vla/datasets/rlds"
OFT = {
    f"{OFT_DATA}/oxe/configs.py": """
from enum import IntEnum
StateEncoding = IntEnum("StateEncoding", {"POS_EULER": 1})
ActionEncoding = IntEnum("ActionEncoding", {"EEF_POS": 1})
OXE_DATASET_CONFIGS = {}
""",
    f"{OFT_DATA}/oxe/transforms.py": """
def libero_dataset_transform(trajectory): ...
OXE_STANDARDIZATION_TRANSFORMS = {}
""",
    f"{OFT_DATA}/oxe/mixtures.py": "OXE_NAMED_MIXTURES = {'bridge': [('bridge_orig', 1.0)]}",
    f"{OFT_DATA}/dataset.py": f"""
from {OFT_DATA.replace("/", ".")}.utils.data_utils import get_dataset_statistics
def make_dataset_from_rlds(name, data_dir):
    info, folder = "counts and sizes of " + name, data_dir + "/" + name + "/1.0.0"
    return get_dataset_statistics([name], hash_dependencies=(info, "state"), save_dir=folder)
""",
    f"{OFT_DATA}/utils/data_utils.py": """
import hashlib, json, os
def get_dataset_statistics(dataset, hash_dependencies, save_dir=None):
    name = hashlib.sha256("".join(hash_dependencies).encode()).hexdigest()
    path = os.path.join(save_dir, "dataset_statistics_" + name + ".json")
    if not os.path.exists(path):
        with open(path, "w") as file:
            json.dump({"num_trajectories": len(dataset)}, file)
    with open(path) as file:
        return json.load(file)
def save_dataset_statistics(statistics, folder):
    (folder / "dataset_statistics.json").write_text(json.dumps(statistics))
""",
    # Its loop counts, warms up and stops as OFT's does.
    "vla-scripts/finetune.py": f"""
import json, sys
from pathlib import Path
import torch
from torch.optim import AdamW
from torch.optim.lr_scheduler import MultiStepLR
from {OFT_DATA.replace("/", ".")}.dataset import make_dataset_from_rlds
from {OFT_DATA.replace("/", ".")}.oxe import configs, mixtures, transforms
from {OFT_DATA.replace("/", ".")}.utils.data_utils import save_dataset_statistics

if __name__ == "__main__":
    arguments = {{}}
    for word in " ".join(sys.argv[1:]).replace("=", " ").split():
        if word.startswith("--"):
            name = word
        else:
            arguments[name] = word
    optimizer = AdamW([torch.nn.Parameter(torch.zeros(1))], lr=float(arguments["--learning_rate"]))
    scheduler = MultiStepLR(optimizer, milestones=[int(arguments["--num_steps_before_decay"])], gamma=0.1)
    warmup, steps = int(arguments["--lr_warmup_steps"]), int(arguments["--max_steps"])
    step = int(arguments["--resume_step"]) if arguments.get("--resume") == "True" else 0
    rates = {{}}
    while step <= steps:
        if warmup > 0:
            for group in optimizer.param_groups:
                group["lr"] = 5e-4 * (0.1 + 0.9 * min((step + 1) / warmup, 1.0))
        rates[step] = optimizer.param_groups[0]["lr"]
        optimizer.step()
        scheduler.step()
        step += 1
    statistics = make_dataset_from_rlds("{NAME}_10", arguments["--data_root_dir"])
    save_dataset_statistics({{"{NAME}_spatial": 1, "{NAME}_10": 2}}, Path("."))
    Path("seen.json").write_text(json.dumps({{
        "arguments": arguments,
        "statistics": statistics,
        "weight_decay": optimizer.param_groups[0]["weight_decay"],
        "rates": rates,
        "configs": configs.OXE_DATASET_CONFIGS,
        "transforms": {{k: v.__name__ for k, v in transforms.OXE_STANDARDIZATION_TRANSFORMS.items()}},
        "mixtures": mixtures.OXE_NAMED_MIXTURES,
    }}))
""",
}


@pytest.fixture
def trained(data: Path, tmp_path: Path) -> Path:
    """A run's data folder of which the training steps of the recipe are few, with an empty RLDS dataset."""
    folder = tmp_path / "data" / "finetune"
    shutil.copytree(data / "finetune", folder)
    shorter = yaml.safe_load((folder / "finetune.yaml").read_text())
    shorter["training"]["steps"]["value"], shorter["training"]["warmup_steps"]["value"] = 500, 100
    (folder / "finetune.yaml").write_text(yaml.safe_dump(shorter))
    (folder.parent / "rlds" / f"{NAME}_10" / "1.0.0").mkdir(parents=True)
    return folder.parent


@pytest.mark.slow
def test_openvla_oft_is_given_datasets_recipe_and_schedule(trained: Path, tmp_path: Path) -> None:
    checkout = stand_in(tmp_path / "oft", OFT)
    seen = run(checkout, trained / "finetune" / "run_openvla_oft.py", "--dataset_name", f"{NAME}_spatial")
    assert seen["mixtures"] == {
        "bridge": [["bridge_orig", 1.0]],
        NAME: [[f"{NAME}_10", 1.0], [f"{NAME}_spatial", 1.0]],
        f"{NAME}_10": [[f"{NAME}_10", 1.0]],
        f"{NAME}_spatial": [[f"{NAME}_spatial", 1.0]],
    }
    assert set(seen["transforms"]) == set(seen["configs"]) == set(SUITES.values())
    assert set(seen["transforms"].values()) == {"libero_dataset_transform"}
    config = seen["configs"][f"{NAME}_10"]
    assert config["image_obs_keys"] == {"primary": "image", "secondary": None, "wrist": "wrist_image"}
    assert config["state_obs_keys"] == ["EEF_state", "gripper_state"]
    arguments = seen["arguments"]
    assert arguments["--data_root_dir"] == str(tmp_path / "data" / "rlds")
    assert arguments["--dataset_name"] == f"{NAME}_spatial", "a user's argument wins"
    given = {"--batch_size": "2", "--use_proprio": "True", "--num_images_in_input": "2", "--max_steps": "500"}
    assert given.items() <= arguments.items()
    assert arguments["--lr_warmup_steps"] == "0", "OFT's own warm-up would undo the cosine"
    assert seen["weight_decay"] == 0.1
    rates = np.array(list(seen["rates"].values()))
    assert np.allclose(rates[[0, 49, 99, 300]], [5e-6, 2.5e-4, 5e-4, 2.5e-4])
    assert rates[-1] < 1e-8
    assert (np.diff(rates[100:]) <= 0).all()
    statistics = json.loads((checkout / "dataset_statistics.json").read_text())
    # OFT's evaluation asks for the suite's name.
    assert (statistics["libero_spatial"], statistics["libero_10"]) == (1, 2)


@pytest.mark.slow
def test_vla_adapter_is_given_its_own_weights_and_keeps_its_optimizer(trained: Path, tmp_path: Path) -> None:
    """Its script has no option for the weights of OpenVLA."""
    checkout, script = stand_in(tmp_path / "adapter", OFT), trained / "finetune" / "run_openvla_oft.py"
    _, _, words = tiny_recipe(tmp_path)["clients"]["vla_adapter"]["command"].partition("run_openvla_oft.py ")
    seen = run(checkout, script, *shlex.split(words), "--lr_warmup_steps", "0", "--max_steps", "5")
    arguments = seen["arguments"]
    assert not {"--vla_path", "--client"} & arguments.keys()
    given = {"--config_file_path": "pretrained_models/configs", "--lora_rank": "64", "--use_proprio": "True"}
    assert given.items() <= arguments.items()
    assert seen["weight_decay"] == 0.01, "PyTorch's, as in its own script"
    assert {*seen["rates"].values()} == {2e-4}
    assert {*seen["transforms"]} == {*SUITES.values()}


@pytest.mark.slow
def test_openvla_oft_resumes_by_its_arguments_and_changes_no_file_of_the_run(trained: Path, tmp_path: Path) -> None:
    checkout, script = stand_in(tmp_path / "oft", OFT), trained / "finetune" / "run_openvla_oft.py"
    files = sorted(trained.rglob("*"))
    words = ["--max_steps=900", "--lr_warmup_steps", "80", "--resume", "True", "--resume_step", "50"]
    rates = {int(step): rate for step, rate in run(checkout, script, *words)["rates"].items()}
    assert (min(rates), max(rates)) == (50, 900)
    assert np.allclose([rates[50], rates[79], rates[490], rates[900]], [5e-4 * 51 / 80, 5e-4, 2.5e-4, 0])
    assert sorted(trained.rglob("*")) == files
    (statistics,) = (checkout / "home" / ".cache").rglob("dataset_statistics_*.json")
    # Not by counts and sizes alone, which another export may share.
    sha256 = tiny_recipe(tmp_path)["dataset"]["sha256"]["value"]
    known_by = f"counts and sizes of {NAME}_10" + "state" + sha256
    assert statistics.stem.endswith(hashlib.sha256(known_by.encode()).hexdigest())


@pytest.mark.slow
def test_openvla_oft_continues_under_the_statistics_of_a_checkpoint(trained: Path, tmp_path: Path) -> None:
    checkout, script = stand_in(tmp_path / "oft", OFT), trained / "finetune" / "run_openvla_oft.py"
    file = tmp_path / "dataset_statistics.json"
    former = {"action": {"q01": [0.5]}, "proprio": {"q01": [0.25]}, "num_trajectories": 432}
    file.write_text(json.dumps({f"{suite}_no_noops": former for suite in SUITES}))
    words = ["--statistics", str(file), "--resume", "True", "--resume_step", "700", "--max_steps", "1200"]
    seen = run(checkout, script, *words)
    assert seen["statistics"] == former | {"num_trajectories": 1}
    rates = [seen["rates"][str(step)] for step in (700, 799, 800, 1000, 1200)]
    assert np.allclose(rates, [5e-6, 5e-4, 5e-4, 2.5e-4, 0])
    assert "--statistics" not in seen["arguments"]
    file.write_text(json.dumps({"bridge": former}))
    done = ended(checkout, script, *words)
    assert done.returncode == 1
    assert "has no statistics for libero_" in done.stderr
    assert "it has: bridge" in done.stderr


def test_a_condition_on_a_level_accepts_a_run_of_joint_levels_alone(tmp_path: Path) -> None:
    joint = row("libero_10", "camera+noise") | {"component": "distance+gauss", "level": "1+3"}
    offered = tiny_recipe(tmp_path, rows=[joint])["dataset"]["labels"]["value"]
    for level in ("1", "3"):
        assert join_conditions([condition(f"level={level}")], offered) == {"level": (level,)}
    with pytest.raises(SystemExit, match="no episode has the level 2"):
        join_conditions([condition("level=2")], offered)


def test_conditions_are_labels_and_their_values() -> None:
    assert condition("axis=clean, camera+noise") == ("axis", ("clean", "camera+noise"))
    assert condition("level=0") == ("level", ("0",))
    for text in ("axis", "axis=", "=camera", "axis=clean,", "", "path_m=1.5", "axes=camera"):
        with pytest.raises(argparse.ArgumentTypeError, match="expected values of axis, component, level"):
            condition(text)
    offered = {"axis": ["camera", "camera+noise", "clean"], "component": ["none", "gauss"], "level": ["0", "3"]}
    given = [condition("axis=clean,noise+camera"), condition("level=0"), condition("axis=camera")]
    assert join_conditions(given, offered) == {"axis": ("clean", "camera+noise", "camera"), "level": ("0",)}
    with pytest.raises(SystemExit, match=r"no episode has the axis camra\n  they have: camera, camera\+noise, clean"):
        join_conditions([condition("axis=clean,camra")], offered)


@pytest.mark.slow
def test_tensorflow_chooses_episodes_by_all_parts_of_their_labels(data: Path, tmp_path: Path) -> None:
    """The script's own filter on episodes as OFT's reader returns them: each label is repeated for every step."""
    script = f"""
import sys, types
import tensorflow as tf

class DLataset:
    @staticmethod
    def from_rlds(builder, split):
        def repeat(labels):
            repeated = {{name: tf.repeat(label[None], 3) for name, label in labels.items()}}
            return {{"traj_metadata": {{"episode_metadata": repeated}}}}
        return tf.data.Dataset.from_tensor_slices({EPISODES}).map(repeat)

sys.modules["dlimp"] = types.SimpleNamespace(DLataset=DLataset)
sys.path.insert(0, {str(data / "finetune")!r})
import run_openvla_oft
run_openvla_oft.choose_episodes(["ours"], {{"axis": ("clean", "camera", "camera+noise"), "level": ("0", "1", "2")}})
for name in ("ours", "libero_goal_no_noops"):
    read = DLataset.from_rlds(types.SimpleNamespace(name=name), split="train")
    print(*(each["traj_metadata"]["episode_metadata"]["episode_id"][0].numpy().decode() for each in read))
run_openvla_oft.choose_episodes(["ours"], {{"level": ("5",)}})
DLataset.from_rlds(types.SimpleNamespace(name="ours"), split="val")
"""
    requirements = ["--with", "tensorflow-cpu==2.21.0", "--with", "tensorflow-datasets==4.9.10"]
    command = ["uv", "run", "--no-project", "--isolated", "--python", "3.11", *requirements, "python", "-c", script]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[-2:] == ["clean weak joint", "clean weak strong joint stronger noise"]
    assert done.returncode == 1
    assert done.stderr.endswith(
        "error: no episode of ours, split val, has level=5\n"
        "  try: other values of --where, or --dataset_name for the dataset of one suite\n"
    )


@pytest.mark.parametrize("isolated", [False, True], ids=["other environment", "no packages at all"])
def test_the_wrong_environment_is_said_in_one_line(isolated: bool, data: Path, tmp_path: Path) -> None:
    stand_in(tmp_path, {"vla-scripts/finetune.py": ""})
    command = [sys.executable, *(["-S"] if isolated else []), str(data / "finetune" / "run_openvla_oft.py")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    missing, tried = done.stderr.splitlines()
    assert missing.startswith("error: ")
    assert ("yaml" if isolated else "prismatic") in missing
    assert "the environment of OpenVLA-OFT" in tried
