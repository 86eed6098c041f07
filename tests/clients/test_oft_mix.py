"""LIBERO's sets next to ours in OpenVLA-OFT: what training makes of an action, evaluation turns back into it.

A stand-in normalises, weighs and looks statistics up as OpenVLA-OFT does (213c5ff). PyTorch, which is only handed an
optimiser, is one too: the real one takes seconds to import.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from short_runs import datasets_in

from pipeline.clients.recipe import build, write
from pipeline.clients.templates.run_openvla_oft import mixed
from pipeline.export_config import ExportConfig
from pipeline.formats.rlds import RldsConfig

RLDS = "prismatic/vla/datasets/rlds"
STAND_INS = {
    "torch/__init__.py": "from torch import optim",
    "torch/optim/__init__.py": "from torch.optim import lr_scheduler\nclass AdamW: ...\nclass Optimizer: ...",
    "torch/optim/lr_scheduler.py": "class LambdaLR: ...",
    f"{RLDS}/oxe/configs.py": """
from enum import IntEnum
StateEncoding = IntEnum("StateEncoding", {"POS_EULER": 1})
ActionEncoding = IntEnum("ActionEncoding", {"EEF_POS": 1})
OXE_DATASET_CONFIGS = {}
""",
    f"{RLDS}/oxe/transforms.py": "def libero_dataset_transform(): ...\nOXE_STANDARDIZATION_TRANSFORMS = {}",
    f"{RLDS}/oxe/mixtures.py": "OXE_NAMED_MIXTURES = {'libero_goal_no_noops': [('libero_goal_no_noops', 1.0)]}",
    f"{RLDS}/utils/data_utils.py": """
import json
import numpy as np
def get_dataset_statistics(dataset, hash_dependencies, save_dir=None):
    figures = {"q01": np.quantile(dataset, 0.01), "q99": np.quantile(dataset, 0.99)}
    return {"action": figures, "proprio": figures, "num_transitions": len(dataset), "num_trajectories": 1}
def save_dataset_statistics(statistics, folder):
    (folder / "dataset_statistics.json").write_text(json.dumps(statistics))
""",
    f"{RLDS}/dataset.py": f"""
import json
from pathlib import Path
import numpy as np
from {RLDS.replace("/", ".")}.oxe.configs import OXE_DATASET_CONFIGS
from {RLDS.replace("/", ".")}.oxe.transforms import OXE_STANDARDIZATION_TRANSFORMS
from {RLDS.replace("/", ".")}.utils.data_utils import get_dataset_statistics
def make_dataset_from_rlds(name, root):
    OXE_DATASET_CONFIGS[name], OXE_STANDARDIZATION_TRANSFORMS[name]
    folder = Path(root, name, "1.0.0")
    actions = np.array(json.loads((folder / "actions.json").read_text()))
    found = get_dataset_statistics(actions, hash_dependencies=("info",), save_dir=str(folder))
    low, high = found["action"]["q01"], found["action"]["q99"]
    return found, 2 * (actions - low) / (high - low) - 1
""",
    "vla-scripts/finetune.py": f"""
import json, sys
from pathlib import Path
from {RLDS.replace("/", ".")}.dataset import make_dataset_from_rlds
from {RLDS.replace("/", ".")}.oxe.mixtures import OXE_NAMED_MIXTURES
from {RLDS.replace("/", ".")}.utils.data_utils import save_dataset_statistics
given = dict(zip(sys.argv[1::2], sys.argv[2::2]))
mixture = dict(OXE_NAMED_MIXTURES[given["--dataset_name"]])
made = {{name: make_dataset_from_rlds(name, given["--data_root_dir"]) for name in mixture}}
sampled = {{name: weight * made[name][0]["num_transitions"] for name, weight in mixture.items()}}
save_dataset_statistics({{name: found for name, (found, _) in made.items()}}, Path("."))
seen = {{"sampled": sampled, "normalised": {{name: values.tolist() for name, (_, values) in made.items()}}}}
Path("seen.json").write_text(json.dumps(seen))
""",
}
ACTIONS = {
    "libero_mine_goal": np.linspace(-0.5, 0.7, 40),
    "libero_mine_spatial": np.linspace(-0.2, 0.3, 30),
    "libero_goal_no_noops": np.linspace(-0.9, 0.9, 100),
    "libero_10_no_noops": np.linspace(-0.1, 0.4, 60),
}
WORDS = ["--mix", "libero_goal_no_noops=0.5", "--mix=libero_10_no_noops=1"]


def trained(folder: Path, *words: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the stand-in saw, and the statistics of its checkpoint, by the commands of docs/clients.md."""
    for name, actions in ACTIONS.items():
        place = folder / ("libero" if name.endswith("_no_noops") else "data/rlds") / name / "1.0.0" / "actions.json"
        place.parent.mkdir(parents=True)
        place.write_text(json.dumps(actions.tolist()))
    (folder / "mix").mkdir()
    subprocess.run("ln -s $PWD/data/rlds/* $PWD/libero/*_no_noops mix", shell=True, cwd=folder, check=True)
    labels = {"axis": "camera", "component": "distance", "level": "2"}
    rows = [
        {"suite": f"libero_{suite}", **labels, "kept": True, "steps": 9, "rlds_shard": f"libero_mine_{suite}-0"}
        for suite in ("goal", "spatial")
    ]
    (folder / "data" / "manifest.parquet").write_bytes(b"rows")
    export = ExportConfig.model_validate({"rlds": RldsConfig(name="libero_mine"), "lerobot": None})
    recipe = build(folder / "data" / "manifest.parquet", rows, export)
    write(recipe, folder / "data" / "finetune", export, datasets_in(folder / "data"))
    checkout = folder / "oft"
    for name, text in STAND_INS.items():
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        (checkout / name).write_text(text)
    subprocess.run(
        [sys.executable, folder / "data/finetune/run_openvla_oft.py", "--data_root_dir", folder / "mix", *words],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout), "HOME": str(folder / "home")},
        check=True,
    )
    return tuple(json.loads((checkout / name).read_text()) for name in ("seen.json", "dataset_statistics.json"))


def evaluated(normalised: list[float], suite: str, statistics: dict[str, Any]) -> Any:
    """The actions that ``run_libero_eval.py`` makes of a policy's, by the key that ``check_unnorm_key`` takes."""
    key = suite if suite in statistics else f"{suite}_no_noops"
    low, high = (statistics[key]["action"][bound] for bound in ("q01", "q99"))
    return 0.5 * (np.array(normalised) + 1) * (high - low) + low


def suite_of(name: str) -> str:
    return name.replace("_mine", "").removesuffix("_no_noops")


def test_evaluation_undoes_what_training_did_to_each_set(tmp_path: Path) -> None:
    seen, statistics = trained(tmp_path, *WORDS)
    assert set(seen["normalised"]) == set(ACTIONS)
    for name, values in seen["normalised"].items():
        np.testing.assert_allclose(evaluated(values, suite_of(name), statistics), ACTIONS[name], atol=1e-12)
    assert seen["sampled"] == {
        "libero_mine_goal": 40,
        "libero_mine_spatial": 30,
        "libero_goal_no_noops": 50,
        "libero_10_no_noops": 60,
    }
    assert statistics["libero_goal"]["action"]["q99"] == np.quantile(ACTIONS["libero_mine_goal"], 0.99)


def test_one_suite_is_mixed_under_the_statistics_of_a_checkpoint(tmp_path: Path) -> None:
    figures = {"action": {"q01": -1.5, "q99": 2.5}, "proprio": {}}
    former = {"libero_goal_no_noops": figures, "libero_10_no_noops": figures}
    (tmp_path / "former.json").write_text(json.dumps(former))
    resumed = ["--resume", "True", "--resume_step", "7", "--max_steps", "9", "--statistics", f"{tmp_path}/former.json"]
    seen, statistics = trained(tmp_path, "--dataset_name", "libero_mine_goal", *resumed, *WORDS)
    assert set(seen["normalised"]) == {"libero_mine_goal", "libero_goal_no_noops", "libero_10_no_noops"}
    for name, values in seen["normalised"].items():
        np.testing.assert_allclose(evaluated(values, suite_of(name), statistics), ACTIONS[name], atol=1e-12)
        np.testing.assert_allclose(values, 2 * (ACTIONS[name] + 1.5) / 4 - 1, atol=1e-12)


@pytest.mark.parametrize("text", ["libero_goal_no_noops", "libero_10_no_noops=0", "libero_10_no_noops=-1", "bridge=1"])
def test_a_set_without_a_weight_or_of_another_kind_is_rejected(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="expected a set of LIBERO and a weight"):
        mixed(text)
