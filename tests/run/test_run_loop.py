"""``run`` performs the stages of any configuration file, several at a time, and does nothing twice."""

import fcntl
import hashlib
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from checkout import IN_SCRIPTS, link_testset, run_pipeline
from short_runs import run_stages, tiny_config

from pipeline import stages
from pipeline.run import manifest


def contents(folder: Path) -> dict[str, tuple[int, str]]:
    """Map every file below a folder to its time of change and its SHA-256, without the report of the checks.

    `push` asks for checks that are younger than the data, so their file is touched.
    """
    found = {}
    for file in sorted(folder.rglob("*")):
        if file.is_file() and file.name != "validation.json":
            checksum = hashlib.sha256(file.read_bytes()).hexdigest()
            found[file.relative_to(folder).as_posix()] = (file.stat().st_mtime_ns, checksum)
    return found


def noise_config(name: str, seed: int, demos: Path) -> dict[str, Any]:
    """A configuration of one task, with two noisy episodes in one format."""
    config = tiny_config(demos)
    config["name"] = name
    config["demos"]["tasks"] = config["demos"]["tasks"][:1]
    config["plan"] = {"seed": seed, "axes": {"noise": {}}, "episodes": {"noise": 2}}
    config["export"] = {"rlds": {"name": "libero_tiny", "shards": 1}, "lerobot": None}
    return config


@pytest.mark.slow
def test_two_runs_that_start_at_the_same_time_make_their_own_datasets(short_demos: Path, tmp_path: Path) -> None:
    """In one folder, from configuration files elsewhere, without params.yaml and without DVC's files."""
    place, elsewhere = tmp_path / "place", tmp_path / "elsewhere"
    place.mkdir()
    elsewhere.mkdir()
    link_testset(place)
    seeds = {"first": 1, "second": 2}
    for name, seed in seeds.items():
        (elsewhere / f"{name}.yaml").write_text(yaml.safe_dump(noise_config(name, seed, short_demos)))
    runs = {}
    for name in seeds:
        command = [sys.executable, "-m", "pipeline", "run", str(elsewhere / f"{name}.yaml")]
        runs[name] = subprocess.Popen(
            command, cwd=place, env=IN_SCRIPTS, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
    printed = {name: process.communicate()[0] for name, process in runs.items()}
    assert {name: process.returncode for name, process in runs.items()} == dict.fromkeys(seeds, 0), printed
    for name, seed in seeds.items():
        rows = manifest.read(place / "data" / name / "manifest.parquet")
        assert {row["seed"] for row in rows} == {seed}
        assert sum(row["kept"] for row in rows) == 3
        assert f"data/{name}/report.html" in printed[name]
    assert sorted(path.name for path in place.iterdir()) == ["data"]

    before = contents(place / "data" / "first")
    again = run_pipeline(place, "run", str(elsewhere / "first.yaml"))
    assert again.returncode == 0, again.stdout + again.stderr
    assert again.stdout.count("up to date") == len([one for one in stages.STAGES.values() if one.outputs or one.record])
    after = contents(place / "data" / "first")
    assert {name for name in before | after if before.get(name) != after.get(name)} <= {"inputs.json", "settings.json"}


@pytest.mark.slow
def test_a_stage_that_is_called_alone_makes_again_what_was_deleted(
    finished: Path, short_demos: Path, tmp_path: Path
) -> None:
    """As people do after an error names a stage's script; nothing listed the change before."""
    data = Path(shutil.copytree(finished, tmp_path / "data" / "tiny"))
    cases = [
        ("replay", next((data / "trajectories").glob("*.npz"))),
        ("render", next((data / "frames").rglob("*.npz"))),
        ("exports", next((data / "rlds").rglob("*.tfrecord*"))),
        ("exports", next((data / "lerobot").rglob("*.mp4"))),
    ]
    for stage, file in cases:
        before = file.read_bytes()
        file.unlink()
        run_stages(tmp_path, tiny_config(short_demos), [stage])
        assert file.read_bytes() == before, stage


def test_a_second_run_of_one_folder_is_rejected(tmp_path: Path, short_demos: Path) -> None:
    """While the first works, which a lock of the folder shows."""
    file = tmp_path / "first.yaml"
    file.write_text(yaml.safe_dump(noise_config("first", 1, short_demos)))
    folder = tmp_path / "data" / "first"
    folder.mkdir(parents=True)
    with (folder / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = run_pipeline(tmp_path, "run", str(file))
    assert done.returncode == 1
    assert "another stage of this run is running" in done.stderr
