"""The fine-tuning recipe says what was kept, and each client finds its set and statistics by its command."""

import inspect
import json
import re
import runpy
import shlex
import subprocess
from importlib import import_module
from importlib.metadata import metadata
from pathlib import Path
from typing import Any

import h5py
import jsonschema
import numpy as np
import pytest
import yaml
from command_words import parse
from short_runs import datasets_in
from synthetic import IDS, SET, TASK, episode, write_hdf5, write_lerobot_v21
from tiny_recipe import NAME, ROWS, SUITES, export_config, row, tiny_recipe
from vla_eval.model_servers.base import ModelServer

from pipeline.clients.recipe import build, write
from pipeline.export_config import ExportConfig
from pipeline.files import schema_file
from pipeline.formats.lerobot import CLIENTS_V30


def evaluated_here(recipe: dict[str, Any]) -> dict[str, Any]:
    """Return the commands by which this project evaluates the policy of a client."""
    commands = {name: client["evaluate"] for name, client in recipe["clients"].items() if "evaluate" in client}
    return {name: words for name, words in commands.items() if words["command"].startswith("python -m pipeline ")}


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
    named = [client for one in export.datasets(tmp_path) for client in one.clients]
    assert sorted(named) == sorted(tiny_recipe(tmp_path, export)["clients"])


def test_policies_of_lerobot_are_left_out_where_the_gripper_is_not_that_of_their_evaluation(tmp_path: Path) -> None:
    export = export_config(lerobot={"name": NAME, "convention": "ipec"})
    recipe = tiny_recipe(tmp_path, export)
    assert not [client for client in recipe["clients"] if client.startswith("lerobot_")]
    missing = recipe["clients_of_other_formats"]
    named = {client for client, setting in missing.items() if setting == "export: {lerobot: {}}"}
    assert named == {*CLIENTS_V30["libero"]}
    assert sorted(client for one in export.datasets(tmp_path) for client in one.clients) == sorted(recipe["clients"])


@pytest.mark.parametrize("convention", [None, "ipec", "openpi"])
def test_a_client_without_its_format_is_named_with_the_setting_that_exports_it(
    convention: str | None, tmp_path: Path
) -> None:
    further = {"lerobot_v21": {"name": NAME, "convention": convention}} if convention else {}
    recipe = tiny_recipe(tmp_path, export_config(**further))
    jsonschema.validate(recipe, json.loads(schema_file("finetune.json").read_text()))
    missing = recipe["clients_of_other_formats"]
    assert not missing.keys() & recipe["clients"].keys()
    assert {"openpi", "gr00t", "starvla"} <= missing.keys() | recipe["clients"].keys()
    for client, setting in missing.items():
        ((name, written),) = yaml.safe_load(setting)["export"].items()
        export = export_config(**{name: {"name": NAME, **written}})
        assert client in tiny_recipe(tmp_path, export)["clients"]


def test_a_run_of_both_conventions_has_all_clients(tmp_path: Path) -> None:
    """Each reads the folder of its convention."""
    export = export_config(
        lerobot_v21={"name": NAME, "convention": "ipec"}, lerobot_openpi={"name": NAME, "validation": 0.1}
    )
    recipe = tiny_recipe(tmp_path, export)
    assert recipe["clients_of_other_formats"].keys() == {"robomimic"}
    assert "$DATA/lerobot_openpi " in recipe["clients"]["openpi"]["command"]
    assert "--datasets.vla_data.data_root_dir lerobot_v21 " in recipe["clients"]["starvla"]["command"]
    assert "test ! -e lerobot_v21 && cp -rs $DATA/lerobot_v21 lerobot_v21`" in recipe["clients"]["starvla"]["where"]
    named = [client for dataset in export.datasets(tmp_path) for client in dataset.clients]
    assert sorted(named) == sorted(recipe["clients"])


def test_robomimic_reads_what_every_demonstration_has(tmp_path: Path) -> None:
    export = export_config(hdf5={"name": NAME})
    recipe = tiny_recipe(tmp_path, export)
    target = write_hdf5(tmp_path)
    datasets = {"hdf5": target.folder, "lerobot": tmp_path}
    write(recipe, tmp_path / "finetune", export, datasets)
    command = recipe["clients"]["robomimic"]["command"].replace("$DATA", str(tmp_path)).replace("SUITE/TASK", TASK)
    words = shlex.split(command)
    options = dict(zip(words[3::2], words[4::2], strict=True))
    config = json.loads(Path(options["--config"]).read_text())
    modalities = config["observation"]["modalities"]["obs"]
    with h5py.File(options["--dataset"]) as file:
        for demo in file["data"].values():
            assert {*modalities["rgb"], *modalities["low_dim"]} <= demo["obs"].keys()
            assert "next_obs" not in demo
    assert not config["train"]["hdf5_load_next_obs"]


def test_openvla_oft_has_the_same_batch_on_any_number_of_gpus(tmp_path: Path) -> None:
    recipe = tiny_recipe(tmp_path)
    client = recipe["clients"]["openvla_oft"]
    training = {name: field["value"] for name, field in recipe["training"].items()}
    assert [setting["gpus"] for setting in client["hardware"]["settings"]] == [8, 4, 2, 1]
    for setting in client["hardware"]["settings"]:
        if "replace" in setting:
            option, gpus = setting["replace"].split()
            assert (f"{option} {training['gpus']} " in client["command"], int(gpus)) == (True, setting["gpus"])
        words = setting.get("append", "").split()
        appended = {option: int(value) for option, value in zip(words[::2], words[1::2], strict=True)}
        batch = setting["gpus"] * appended.get("--batch_size", training["batch_size_per_gpu"])
        assert batch * appended.get("--grad_accumulation_steps", 1) == training["effective_batch_size"]


def test_clients_of_formats_that_are_left_out_are_named(tmp_path: Path) -> None:
    v21 = {"name": NAME, "convention": "ipec"}
    export = ExportConfig.model_validate({"rlds": None, "lerobot": None, "lerobot_v21": v21})
    missing = tiny_recipe(tmp_path, export)["clients_of_other_formats"]
    oft, act = (yaml.safe_load(missing[client])["export"] for client in ("openvla_oft", "lerobot_act"))
    assert "rlds" in ExportConfig.model_validate({"lerobot": None, **oft}).formats
    assert "lerobot" in ExportConfig.model_validate({"rlds": None, **act}).formats


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
def test_the_schema_rejects_wrong_values(section: str, field: str, value: object, tmp_path: Path) -> None:
    schema, recipe = json.loads(schema_file("finetune.json").read_text()), tiny_recipe(tmp_path)
    jsonschema.validate(recipe, schema)
    recipe[section] = recipe[section] | {field: value}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(recipe, schema)


def test_written_recipe_is_read_back_and_its_commands_can_be_copied(tmp_path: Path) -> None:
    recipe = tiny_recipe(tmp_path)
    write(recipe, tmp_path / "finetune", export_config(), datasets_in(tmp_path))
    text = (tmp_path / "finetune" / "finetune.yaml").read_text()
    assert yaml.safe_load(text) == recipe
    assert all(client["command"] in text for client in recipe["clients"].values())


def test_the_evaluation_of_each_trained_policy_is_understood_by_both_programs(tmp_path: Path) -> None:
    """vla-eval's servers have the parameters, and ``evaluate`` the options; chunks have the length of the training."""
    export = export_config(lerobot_openpi={"name": NAME, "validation": 0.1})
    recipe = tiny_recipe(tmp_path, export)
    evaluated = evaluated_here(recipe)
    assert evaluated.keys() == {"openvla_oft", "openpi", *CLIENTS_V30["libero"]}
    for commands in evaluated.values():
        words = shlex.split(commands["command"])
        assert words[:3] == ["python", "-m", "pipeline"]
        options = parse(words[3:]).params
        assert (options["server"] is None) == ("server" not in commands)
        if "server" not in commands:
            continue
        words = shlex.split(commands["server"])
        module = words[words.index("-m") + 1]
        (server,) = (
            kind for kind in vars(import_module(module)).values()
            if isinstance(kind, type) and issubclass(kind, ModelServer) and kind.__module__ == module
        )  # fmt: skip
        given = [word.removeprefix("--args.") for word in words if word.startswith("--args.")]
        assert {*given} <= inspect.signature(server).parameters.keys()
        assert options["look_every"] == int(words[words.index("--args.chunk_size") + 1])
    chunk = recipe["training"]["chunk"]["value"]
    assert f"--args.chunk_size {chunk}" in evaluated["openvla_oft"]["server"]


@pytest.mark.parametrize("action", ["delta", "absolute"])
def test_policies_are_evaluated_with_the_actions_that_they_are_trained_on(action: str, tmp_path: Path) -> None:
    """The column of goals is lerobot's alone; RLDS has deltas."""
    evaluated = evaluated_here(tiny_recipe(tmp_path, export_config(lerobot={"name": NAME, "action": action})))
    executed = {}
    for name, commands in evaluated.items():
        executed[name] = parse(shlex.split(commands["command"])[3:]).params["actions"] or "delta"
    assert executed == {"openvla_oft": "delta", **dict.fromkeys(CLIENTS_V30["libero"], action)}


def test_policies_of_own_tasks_are_evaluated_on_these(tmp_path: Path) -> None:
    """By default, ``evaluate`` tests LIBERO's four suites, and it has no step limit for others."""
    export = export_config(lerobot_openpi={"name": NAME, "validation": 0.1})
    tiny_recipe(tmp_path, export)
    rows = [{**row, "suite": "table"} if row["suite"] == "libero_spatial" else row for row in ROWS]
    recipe = build(tmp_path / "manifest.parquet", rows, export)
    jsonschema.validate(recipe, json.loads(schema_file("finetune.json").read_text()))
    for name, commands in evaluated_here(recipe).items():
        words = shlex.split(commands["command"].replace("--own-step-limit N", "--own-step-limit 150"))
        suites = ("SUITE",) if name == "openvla_oft" else ("libero_10", "table")
        assert [words[k + 1] for k, word in enumerate(words) if word == "--suite"] == [*suites], name
        assert words[words.index("--own-step-limit") + 1] == "150"
    assert "N is the number of control steps" in recipe["evaluation"]["own_tasks"]


@pytest.mark.parametrize("client", CLIENTS_V30["libero"])
def test_pypi_has_the_extras_that_a_client_needs(client: str, tmp_path: Path) -> None:
    """pip only warns of a missing extra. An extra of lerobot's repository has an address after it."""
    lerobot = metadata("lerobot")
    before, since = tiny_recipe(tmp_path)["clients"][client]["where"].split("since lerobot 0.6")
    text = before if lerobot["Version"].startswith("0.4.") else since
    named = [extra for names in re.findall(r"lerobot\[([\w,]+)\](?! @)", text) for extra in names.split(",")]
    assert {*named} <= {*lerobot.get_all("Provides-Extra", [])}


def test_openpi_finds_set_and_statistics_by_the_command_of_the_recipe(tmp_path: Path) -> None:
    """The command as openpi itself was given it: ``benchmarks/clients/read_v21.py``."""
    target = write_lerobot_v21(tmp_path, "openpi")
    options = export_config(lerobot_v21=target.options)
    recipe = tiny_recipe(tmp_path, options)
    write(recipe, tmp_path / "finetune", options, datasets_in(tmp_path))
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
    write(recipe, tmp_path / "finetune", options, datasets_in(tmp_path))
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
    """As ``check_stats_validity`` in its ``gr00t/data/stats.py`` (23ace64) asks; else it writes them again."""
    root = write_lerobot_v21(tmp_path, "ipec").root / SET
    info, stats = (json.loads((root / "meta" / name).read_text()) for name in ("info.json", "stats.json"))
    numbers = [name for name, of in info["features"].items() if "float" in of["dtype"]]
    assert {"observation.state", "action"} < {*numbers}
    for name in numbers:
        assert {"mean", "std", "min", "max", "q01", "q99"} <= stats[name].keys()


@pytest.mark.parametrize("client", ["starvla", "gr00t"])
def test_files_that_a_client_adds_or_replaces_do_not_reach_the_dataset(client: str, tmp_path: Path) -> None:
    data, checkout = tmp_path / "data", tmp_path / "checkout"
    target = write_lerobot_v21(data, "ipec")
    options = export_config(lerobot_v21=target.options)
    recipe = tiny_recipe(tmp_path, options)
    write(recipe, data / "finetune", options, datasets_in(data))
    before = {path: path.read_bytes() for path in data.rglob("*") if path.is_file()}
    modality = checkout / "examples" / "LIBERO" / "modality.json"
    modality.parent.mkdir(parents=True)
    modality.write_text("of GR00T")
    for line in re.findall(r"`([^`]*cp [^`]*)`", recipe["clients"][client]["where"]):
        command = re.sub(r"\bSET\b", SET, line).replace("$DATA", str(data))
        subprocess.run(["bash", "-ec", command], cwd=checkout, check=True)
    (folder,) = (path.parent for path in checkout.rglob("meta") if path.parent.name == SET)
    (folder / "meta" / "added.json").write_text("{}")
    assert {path: path.read_bytes() for path in data.rglob("*") if path.is_file()} == before
    assert all(path.is_symlink() for path in (folder / "data").rglob("*.parquet"))
    assert ((folder / "meta" / "modality.json").read_text() == "of GR00T") == (client == "gr00t")


def test_starvla_serves_and_evaluates_its_last_checkpoint(tmp_path: Path) -> None:
    export = export_config(lerobot_v21={"name": NAME, "convention": "ipec"})
    client = tiny_recipe(tmp_path, export)["clients"]["starvla"]
    words = shlex.split(client["command"])
    root, run, steps, interval = (
        words[words.index(option) + 1]
        for option in ("--run_root_dir", "--run_id", "--trainer.max_train_steps", "--trainer.save_interval")
    )
    checkpoint = f"{root}/{run}/checkpoints/steps_{steps}_pytorch_model.pt"
    assert int(steps) % int(interval) == 0, "starVLA stores the last step only at a multiple"
    assert f"--ckpt_path {checkpoint} --port 6694 " in client["evaluate"]["server"]
    assert f" CKPT={checkpoint} PORT=6694 " in client["evaluate"]["command"]


def test_gr00t_serves_its_last_checkpoint(tmp_path: Path) -> None:
    export = export_config(lerobot_v21={"name": NAME, "convention": "ipec"})
    client = tiny_recipe(tmp_path, export)["clients"]["gr00t"]
    words = shlex.split(client["command"])
    settings = dict(word.split("=") for word in words if "=" in word)
    folder, tag = (words[words.index(option) + 1] for option in ("--output-dir", "--embodiment-tag"))
    assert int(settings["MAX_STEPS"]) % int(settings["SAVE_STEPS"]) == 0
    served = f"--model-path {folder}/checkpoint-{settings['MAX_STEPS']} --embodiment-tag {tag} "
    assert served in client["evaluate"]["server"]
