"""The fine-tuning recipe, and the clients' scripts: run as a user would, in stand-ins for the clients' checkouts.

OpenVLA-OFT cannot be installed here. A stand-in has the names that the scripts touch, and a training script
that writes down what it was given.
"""

import hashlib
import json
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import torch
import yaml
from synthetic import IDS, SET, episode, write_lerobot_v21

from pipeline.clients.recipe import build, write
from pipeline.clients.templates.run_openvla_oft import read_schedule, set_optimiser
from pipeline.export_config import ExportConfig, LeRobotConfig, RldsConfig
from pipeline.files import schema_file
from pipeline.formats.registry import formats_of

NAME = "libero_tiny"
SUITES = {"libero_spatial": f"{NAME}_spatial", "libero_10": f"{NAME}_10"}


def row(suite: str, axis: str, kept: bool = True) -> dict[str, Any]:
    shard = f"{SUITES[suite]}-train.tfrecord-00000-of-00002" if kept else None
    return {"suite": suite, "axis": axis, "kept": kept, "steps": 100 if kept else None, "rlds_shard": shard}


ROWS = [
    row("libero_spatial", "clean"),
    row("libero_spatial", "camera"),
    row("libero_spatial", "camera"),
    row("libero_10", "light"),
    row("libero_10", "camera", kept=False),
]


def export_config(name: str = NAME, **further: Any) -> ExportConfig:
    return ExportConfig(rlds=RldsConfig(name=name, shards=2), lerobot=LeRobotConfig(name="tiny", shards=1), **further)


def tiny_recipe(folder: Path, export: ExportConfig | None = None, rows: list[dict[str, Any]] = ROWS) -> dict[str, Any]:
    file = folder / "manifest.parquet"
    file.write_bytes(b"rows")
    return build(file, rows, export or export_config())


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's data folder with what the recipe stage writes."""
    data = tmp_path_factory.mktemp("data")
    write(tiny_recipe(data), data, export_config())
    return data


def test_recipe_counts_what_was_kept(tmp_path: Path) -> None:
    recipe = tiny_recipe(tmp_path)
    dataset = {name: field["value"] for name, field in recipe["dataset"].items()}
    assert (dataset["episodes"], dataset["steps"]) == (4, 400)
    assert dataset["episodes_by_suite_and_axis"] == {
        "libero_spatial": {"clean": 1, "camera": 2},
        "libero_10": {"light": 1},
    }
    assert dataset["suites"] == SUITES
    # By this name OpenVLA-OFT looks for the mixture; the LeRobot dataset has another.
    assert dataset["mixtures"] == {recipe["name"]: dict.fromkeys(sorted(SUITES.values()), 1.0)}
    assert recipe["name"] == NAME != dataset["lerobot"]
    values = {name: field["value"] for name, field in recipe["training"].items()}
    assert values["effective_batch_size"] == values["gpus"] * values["batch_size_per_gpu"]
    assert all(field["source"] for field in (*recipe["dataset"].values(), *recipe["training"].values()))


@pytest.mark.parametrize(("held_out", "asked"), [((), False), (("libero_10",), False), (tuple(SUITES), True)])
def test_openvla_oft_measures_what_every_set_holds_out(held_out: tuple[str, ...], asked: bool, tmp_path: Path) -> None:
    """It fails where a set has no split ``val``, and never trains on one."""
    kept = [row(suite, "camera") for suite in SUITES]
    for suite in held_out:
        one = row(suite, "camera")
        kept.append(one | {"rlds_shard": one["rlds_shard"].replace("-train.", "-val.")})
    command = tiny_recipe(tmp_path, rows=kept)["clients"]["openvla_oft"]["command"]
    assert command.endswith(" --use_val_set True") == asked


@pytest.mark.parametrize("convention", ["ipec", "openpi"])
def test_every_client_is_named_by_the_format_that_it_reads(convention: str, tmp_path: Path) -> None:
    export = export_config(lerobot_v21={"name": NAME, "convention": convention})
    named = [client for one in formats_of(tmp_path, export) for client in one.clients]
    assert sorted(named) == sorted(tiny_recipe(tmp_path, export)["clients"])


def test_recipe_changes_with_the_dataset(tmp_path: Path) -> None:
    (tmp_path / "other.parquet").write_bytes(b"other rows")
    other = build(tmp_path / "other.parquet", ROWS, export_config())
    assert other["dataset"]["sha256"] != tiny_recipe(tmp_path)["dataset"]["sha256"]


@pytest.mark.parametrize(
    ("section", "field", "value"),
    [
        ("training", "learning_rate", {"value": 0, "source": "x"}),
        ("training", "weight_decay", {"value": 0.1}),
        ("training", "schedule", {"value": "step", "source": "x"}),
        ("dataset", "sha256", {"value": "short", "source": "x"}),
        ("dataset", "extra", {"value": 1, "source": "x"}),
    ],
)
def test_schema_refuses(section: str, field: str, value: object, tmp_path: Path) -> None:
    schema, recipe = json.loads(schema_file("finetune.json").read_text()), tiny_recipe(tmp_path)
    jsonschema.validate(recipe, schema)
    recipe[section] = recipe[section] | {field: value}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(recipe, schema)


@pytest.mark.slow
def test_written_recipe_is_read_back_and_its_commands_can_be_copied(data: Path) -> None:
    text = (data / "finetune" / "finetune.yaml").read_text()
    recipe = yaml.safe_load(text)
    assert recipe == tiny_recipe(data)
    assert all(client["command"] in text for client in recipe["clients"].values())


def run(folder: Path, script: Path, *arguments: str) -> dict[str, Any]:
    """Run a client's script in a stand-in checkout; returns what its training script wrote down."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "HOME": str(folder / "home")}
    command = [sys.executable, str(script), *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    seen: dict[str, Any] = json.loads((folder / "seen.json").read_text())
    return seen


def stand_in(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


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
    done = subprocess.run(
        [sys.executable, str(script), *words],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout), "HOME": str(checkout / "home")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "has no statistics for libero_" in done.stderr
    assert "it has: bridge" in done.stderr


@pytest.mark.parametrize(
    ("words", "first", "shares"),
    [
        ([], 0, {0: 0.05, 19: 1, 20: 1, 1010: 0.5, 2000: 0}),
        (["--max_steps", "400"], 0, {0: 0.25, 3: 1, 4: 1, 202: 0.5, 400: 0}),
        (["--max_steps=200", "--lr_warmup_steps=0"], 0, {0: 1, 100: 0.5, 200: 0}),
        (["--max_steps", "1_000", "--lr_warmup_steps", "10"], 0, {0: 0.1, 9: 1, 10: 1, 505: 0.5, 1000: 0}),
        (["--resume", "true", "--resume_step", "1010"], 1010, {1010: 0.5, 2000: 0}),
        (["--resume=True", "--resume_step=4", "--max_steps=900"], 4, {4: 5 / 9, 8: 1, 9: 1, 900: 0}),
        (["--resume", "False", "--resume_step", "300"], 0, {0: 0.05, 19: 1, 1010: 0.5, 2000: 0}),
    ],
)
def test_the_rate_follows_steps_warm_up_and_resumption(
    words: list[str], first: int, shares: dict[int, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, name in ((torch.optim, "AdamW"), (torch.optim.lr_scheduler, "MultiStepLR")):
        monkeypatch.setattr(module, name, getattr(module, name))  # restored after the test
    set_optimiser(0.1, read_schedule(words, steps=2000, warmup_steps=20))
    optimizer = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(1))], lr=5e-4)
    scheduler = torch.optim.lr_scheduler.MultiStepLR(optimizer, milestones=[100_000], gamma=0.1)
    rates = {}
    for step in range(first, max(shares) + 1):
        rates[step] = optimizer.param_groups[0]["lr"]
        optimizer.step()
        scheduler.step()
    assert {step: rates[step] for step in shares} == pytest.approx({k: 5e-4 * v for k, v in shares.items()}, abs=1e-12)


def test_a_checkpoint_of_another_training_begins_a_schedule_of_its_own() -> None:
    words = ["--resume", "True", "--resume_step", "150_000", "--max_steps", "170_000"]
    schedule = read_schedule(words, steps=100_000, warmup_steps=1000, anew=True)
    shares = {step: schedule.share(step) for step in (0, 199, 200, 10_100, 20_000)}
    assert shares == pytest.approx({0: 1 / 200, 199: 1, 200: 1, 10_100: 0.5, 20_000: 0})


@pytest.mark.parametrize(
    ("words", "anew", "said"),
    [
        (["--resume", "True", "--resume_step", "150000"], False, "--max_steps 250000 for 100000 more"),
        (["--resume", "True", "--resume_step", "150000"], True, "150000 is not below --max_steps 100000"),
        (["--resume_step", "150000", "--max_steps", "170000"], True, "--statistics without --resume"),
    ],
)
def test_a_resumption_that_would_train_something_else_is_refused(words: list[str], anew: bool, said: str) -> None:
    with pytest.raises(SystemExit, match=said):
        read_schedule(words, steps=100_000, warmup_steps=1000, anew=anew)


def test_openpi_finds_set_and_statistics_by_the_command_of_the_recipe(tmp_path: Path) -> None:
    """The command as openpi itself was given it: ``benchmarks/clients/read_v21.py``."""
    target = write_lerobot_v21(tmp_path, "openpi")
    options = export_config(lerobot_v21=target.options)
    recipe = tiny_recipe(tmp_path, options)
    write(recipe, tmp_path, options)
    command = recipe["clients"]["openpi"]["command"].replace("$DATA", str(tmp_path))
    given = dict(word.split("=") for word in command.split() if "=" in word)
    root = Path(given["HF_LEROBOT_HOME"], given["--data.repo-id"])
    assert json.loads((root / "meta" / "info.json").read_text())["total_episodes"] == len(IDS)
    file = Path(given["--data.assets.assets-dir"], given["--data.assets.asset-id"], "norm_stats.json")
    found = json.loads(file.read_text())["norm_stats"]
    for name, column in (("actions", "action"), ("state", "state")):
        values = np.concatenate([getattr(episode(one), column) for one in IDS]).astype(np.float64)
        assert np.allclose(found[name]["mean"], values.mean(0), atol=1e-12)
        assert np.allclose(found[name]["q99"], np.quantile(values, 0.99, axis=0), atol=1e-12)
    serve = recipe["clients"]["openpi_serve"]["command"]
    assert "--policy.dir=checkpoints/pi05_libero/synthetic/29999" in serve


def test_starvla_finds_the_sets_of_every_suite(tmp_path: Path) -> None:
    target = write_lerobot_v21(tmp_path, "ipec")
    options = export_config(lerobot_v21=target.options)
    recipe = tiny_recipe(tmp_path, options)
    write(recipe, tmp_path, options)
    (found,) = runpy.run_path(str(tmp_path / "finetune" / "starvla_data_config.py"))["DATASET_NAMED_MIXTURES"].items()
    assert found == ("synthetic", [(SET, 1.0, "libero_franka")])
    assert (tmp_path / "lerobot_v21" / SET / "meta" / "modality.json").is_file()
    command = recipe["clients"]["starvla"]["command"]
    assert "--datasets.vla_data.data_mix synthetic" in command
    # What its script for LIBERO changes of the configuration, by which the language model would be frozen (0ed0aad).
    assert "--framework.name QwenPI" in command
    assert "--trainer.freeze_modules --trainer.max_train_steps 80000 --trainer.save_interval 10000" in command
    assert "openpi" not in recipe["clients"]


def test_gr00t_leaves_the_statistics_of_a_set_as_they_are(tmp_path: Path) -> None:
    """As ``check_stats_validity`` in its ``gr00t/data/stats.py`` (23ace64) asks; else it writes them anew."""
    root = write_lerobot_v21(tmp_path, "ipec").root / SET
    info, stats = (json.loads((root / "meta" / name).read_text()) for name in ("info.json", "stats.json"))
    numbers = [name for name, of in info["features"].items() if "float" in of["dtype"]]
    assert {"observation.state", "action"} < {*numbers}
    for name in numbers:
        assert {"mean", "std", "min", "max", "q01", "q99"} <= stats[name].keys()


@pytest.mark.parametrize("isolated", [False, True], ids=["other environment", "no packages at all"])
@pytest.mark.parametrize(
    ("script", "checkout", "words", "remedy"),
    [
        ("run_openvla_oft.py", "vla-scripts/finetune.py", [], "the environment of OpenVLA-OFT"),
    ],
)
def test_the_wrong_environment_is_said_in_one_line(
    script: str, checkout: str, words: list[str], remedy: str, isolated: bool, data: Path, tmp_path: Path
) -> None:
    stand_in(tmp_path, {checkout: ""})
    command = [sys.executable, *(["-S"] if isolated else []), str(data / "finetune" / script), *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    missing, tried = done.stderr.splitlines()
    assert missing.startswith("error: ")
    assert ("yaml" if isolated else script.split("_")[1].replace("openvla", "prismatic").removesuffix(".py")) in missing
    assert remedy in tried
