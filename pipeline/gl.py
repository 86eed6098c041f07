"""Choice of the OpenGL renderer: a GPU through EGL, else Mesa in software through EGL, else OSMesa.

The first renderer of a process triggers the choice. An import never does, because physics needs no OpenGL. Worker
processes inherit the choice. Two renderers may differ by some grey levels, so the choice is printed and recorded.
"""

import ctypes
import functools
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import chain, count
from math import ceil
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError

BACKENDS = ("egl", "osmesa")
REMEDY = "run setup.sh, or as root `apt-get install -y libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libosmesa6`"
NVIDIA_EGL = "libEGL_nvidia.so.0"
VENDOR_FOLDERS = "/etc/glvnd/egl_vendor.d:/usr/share/glvnd/egl_vendor.d"
DEVICES, LOADED_GPUS = Path("/dev"), Path("/proc/driver/nvidia/gpus")


ASKED = "selected by MUJOCO_GL"
"""Reason of a choice by the user."""


@dataclass(frozen=True)
class GlChoice:
    """Renderer of this process and of its child processes.

    Attributes:
        backend: ``egl`` or ``osmesa``.
        device: the renderer and its driver, as OpenGL names them.
        reason: reason of the choice.
        device_named: True if ``MUJOCO_EGL_DEVICE_ID`` named the device, so that no other device may be used.
        sharing: number of processes that render on the device at a time, or more; 1 if it is not known.
    """

    backend: str
    device: str
    reason: str
    device_named: bool = False
    sharing: int = 1

    @property
    def software(self) -> bool:
        return _is_software(self.device)

    def __str__(self) -> str:
        return f"rendering with {self.backend} on {self.device}: {self.reason}"


_ENVIRONMENT = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID")
_of_the_run: GlChoice | None = None


@functools.cache
def choose() -> GlChoice:
    """Try the renderers in short subprocesses (0.7 s each), set the environment, return the choice for printing.

    ``MUJOCO_GL`` and ``MUJOCO_EGL_DEVICE_ID`` are respected where they are set. A worker of this machine uses the
    choice of the run's own process (``WorkerSetup``).

    Raises:
        PipelineError: when ``MUJOCO_GL`` names a back end that does not render here, or when no back end renders; or as
            ``check_device``.
    """
    if _of_the_run is not None:
        return _of_the_run
    check_device()
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    device_named = "MUJOCO_EGL_DEVICE_ID" in os.environ
    faults = {}
    for backend in BACKENDS:
        if asked not in ("", backend):
            continue
        try:
            device, index = _best_device(backend)
        except _NoDeviceError as error:
            faults[backend] = str(error)
            continue
        os.environ.update(MUJOCO_GL=backend, PYOPENGL_PLATFORM=backend)
        if index is not None:
            os.environ["MUJOCO_EGL_DEVICE_ID"] = index
        reason = ASKED if asked else _reason(backend, device, faults)
        return GlChoice(backend, device, reason, device_named)

    what = "; ".join(f"{backend} fails: {fault}" for backend, fault in faults.items())
    raise PipelineError(
        f"{f'MUJOCO_GL={asked} does not render' if asked else 'no OpenGL back end renders'} here "
        f"({what or 'unknown back end'})",
        expected=" or ".join(BACKENDS),
        remedy=f"unset MUJOCO_GL; {REMEDY}" if asked else REMEDY,
    )


def check_device() -> None:
    """Compare ``MUJOCO_EGL_DEVICE_ID`` with ``CUDA_VISIBLE_DEVICES``; robosuite cannot be imported if they disagree.

    Raises:
        PipelineError: when ``CUDA_VISIBLE_DEVICES`` does not list the device.
    """
    device, visible = os.environ.get("MUJOCO_EGL_DEVICE_ID"), _visible_devices()
    if device is None or not visible or (device.isdigit() and device in visible):
        return
    named = [number for number in visible if number.isdigit()]
    raise PipelineError(
        f"MUJOCO_EGL_DEVICE_ID={device} is not among CUDA_VISIBLE_DEVICES={os.environ['CUDA_VISIBLE_DEVICES']}",
        expected="a number of CUDA_VISIBLE_DEVICES, as robosuite renders on no other GPU",
        remedy=f"export MUJOCO_EGL_DEVICE_ID={named[0]}, or unset it" if named else "unset MUJOCO_EGL_DEVICE_ID",
    )


def _visible_devices() -> list[str]:
    """List the entries of ``CUDA_VISIBLE_DEVICES``; empty if the variable does not limit the GPUs."""
    return [device.strip() for device in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if device.strip()]


@functools.cache
def gpus() -> tuple[str, ...]:
    """Return EGL's indices of all GPUs like the chosen one, for worker processes to share.

    The tuple is empty where the device is fixed or no GPU renders, and where ``CUDA_VISIBLE_DEVICES`` does not list
    numbers.
    """
    choice = choose()
    if choice.software or choice.device_named or choice.backend != "egl":
        return ()
    visible = _visible_devices()
    if not all(device.isdigit() for device in visible):
        return ()
    indices = []
    for index in visible or map(str, count()):
        try:
            device = _probe("egl", index)
        except _NoDeviceError:
            # No GPU has this number, as EGL counts without gaps.
            break
        if device == choice.device:
            indices.append(index)
    return tuple(indices)


class WorkerSetup:
    """Choice of this process for worker processes of this machine, which skip the trials. Raises as ``choose``.

    Args:
        workers: number of workers, which share the GPUs evenly.
    """

    def __init__(self, workers: int):
        self._gpus = gpus()
        self._choice = replace(choose(), sharing=ceil(workers / max(1, len(self._gpus))))
        self._environment = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}

    def __call__(self, worker: int) -> None:
        """Make this process, the worker with this number, render with the choice, on one of several GPUs in turn."""
        global _of_the_run
        _of_the_run = self._choice
        os.environ.update(self._environment)
        if self._gpus:
            # MuJoCo reads the variable when it opens its first context.
            os.environ["MUJOCO_EGL_DEVICE_ID"] = self._gpus[worker % len(self._gpus)]


def prepare() -> None:
    """Make MuJoCo render with the result of ``choose``, also if MuJoCo was imported before without OpenGL."""
    backend = choose().backend
    # mujoco.Renderer reads its context class from this module. MuJoCo itself sets it by MUJOCO_GL, but only at import.
    context: Any = import_module("mujoco.gl_context")
    context.GLContext = import_module(f"mujoco.{backend}").GLContext


def import_mujoco() -> None:
    """Import MuJoCo without OpenGL; a plain import loads the library of ``MUJOCO_GL`` and fails if it is missing."""
    with left_out():
        import mujoco  # noqa: F401


@contextmanager
def left_out() -> Iterator[None]:
    """Keep MuJoCo and robosuite from loading OpenGL when the block imports them, for any value of ``MUJOCO_GL``.

    Raises:
        PipelineError: as ``check_device``.
    """
    check_device()
    asked = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        yield
    finally:
        del os.environ["MUJOCO_GL"]
        if asked is not None:
            os.environ["MUJOCO_GL"] = asked


class _NoDeviceError(Exception):
    """A back end that rendered nothing, with the reason."""


def _best_device(backend: str) -> tuple[str, str | None]:
    """Return the first GPU, or else the first renderer: its name and the ``MUJOCO_EGL_DEVICE_ID`` that it needs."""
    index = os.environ.get("MUJOCO_EGL_DEVICE_ID")
    # Render on the GPU of the job, if EGL and CUDA use the same numbers: robosuite follows the same rule, and
    # rejects a device that is not in this list. Without an index MuJoCo uses the first device that answers.
    first_visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")[0]
    if backend == "egl" and index is None and first_visible.isdigit():
        with suppress(_NoDeviceError):
            device = _probe(backend, first_visible)
            if not _is_software(device):
                return device, first_visible
    return _probe(backend, index), index


def _probe(backend: str, index: str | None) -> str:
    """Render one frame in a separate process, because a broken driver may end its process."""
    environment = os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    if index is not None:
        environment["MUJOCO_EGL_DEVICE_ID"] = index
    command = [sys.executable, "-m", "pipeline.gl"]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        raise _NoDeviceError("no frame within 60 s") from None
    if done.returncode != 0:
        raise _NoDeviceError(done.stdout.strip() or f"the driver ended the process with status {done.returncode}")
    return done.stdout.strip()


def idle_gpu() -> tuple[str, str] | None:
    """Return why no GPU of this machine renders, and the remedy; ``None`` if the machine has no GPU.

    EGL needs a device node that this user may open. For NVIDIA it also needs the driver's library, and a file that
    names the library in a folder that libglvnd reads (its src/EGL/icd_enumeration.md).
    """
    nvidia = sorted(DEVICES.glob("nvidia[0-9]*"))
    closed = []
    for node in (*nvidia, *sorted(DEVICES.glob("dri/renderD*"))):
        if not os.access(node, os.R_OK | os.W_OK, effective_ids=True):
            closed.append(node)
    if not nvidia and LOADED_GPUS.is_dir():
        return (
            f"NVIDIA's driver is loaded, but {DEVICES}/nvidia0 is missing",
            "run `nvidia-modprobe -u -c=0` as root; start a container with --nv (Apptainer), "
            "--device nvidia.com/gpu=all (Podman) or --gpus all (Docker)",
        )
    if nvidia and not _loads(NVIDIA_EGL):
        return (
            f"{NVIDIA_EGL} is missing",
            "install the driver's EGL library (Debian: libegl-nvidia0, Ubuntu: libnvidia-gl-VERSION); in a container, "
            "add graphics to NVIDIA_DRIVER_CAPABILITIES",
        )
    if nvidia and not any(NVIDIA_EGL in file.read_text(errors="replace") for file in _vendor_files()):
        vendor_file = json.dumps({"file_format_version": "1.0.0", "ICD": {"library_path": NVIDIA_EGL}})
        return (
            f"no EGL vendor file names {NVIDIA_EGL}",
            f"run echo '{vendor_file}' | sudo tee /usr/share/glvnd/egl_vendor.d/10_nvidia.json; "
            "unset __EGL_VENDOR_LIBRARY_FILENAMES __EGL_VENDOR_LIBRARY_DIRS",
        )
    if closed:
        return (
            f"this user has no permission to open {closed[0]}",
            f"run sudo usermod -aG $(stat -c %G {closed[0]}) $USER, then log in again; in Podman, add "
            "--group-add keep-groups",
        )
    if nvidia:
        return "the GPU's driver does not answer", "check that nvidia-smi works; unset MUJOCO_GL MUJOCO_EGL_DEVICE_ID"
    return None


def _loads(library: str) -> bool:
    """Return whether the loader finds a library, also by ``LD_LIBRARY_PATH``, which containers use for the driver."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _vendor_files() -> list[Path]:
    """List the files that tell libglvnd about the installed drivers."""
    filenames = os.environ.get("__EGL_VENDOR_LIBRARY_FILENAMES")
    if filenames:
        files = [Path(file) for file in filenames.split(":")]
    else:
        folders = os.environ.get("__EGL_VENDOR_LIBRARY_DIRS", VENDOR_FOLDERS).split(":")
        files = list(chain.from_iterable(Path(folder).glob("*.json") for folder in folders))
    return [file for file in files if file.is_file()]


def _is_software(device: str) -> bool:
    return device.startswith(("llvmpipe", "softpipe", "swrast"))


def _reason(backend: str, device: str, faults: dict[str, str]) -> str:
    if not _is_software(device):
        return "a GPU"
    idle = idle_gpu()
    if idle:
        return f"software, many times slower than this machine's GPU, which does not render: {idle[0]}; {idle[1]}"
    return f"software, as EGL fails: {faults['egl']}" if backend == "osmesa" else "software, as no GPU answers"


def _render_once() -> str:
    """Render a frame, as a context alone proves little, and return the name of this process's renderer."""
    import mujoco
    from OpenGL import GL

    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light/><geom size='1'/></worldbody></mujoco>")
    with mujoco.Renderer(model, 64, 64) as renderer:
        renderer.update_scene(mujoco.MjData(model))
        renderer.render()
        return ", ".join(GL.glGetString(name).decode() for name in (GL.GL_RENDERER, GL.GL_VERSION))


if __name__ == "__main__":
    try:
        print(_render_once())
    except Exception as error:  # Drivers and loaders fail in many ways, and the caller reports each of them.
        print(f"{type(error).__name__}: {error}")
        sys.exit(1)
