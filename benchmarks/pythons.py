"""Comparison of two starter tasks with every axis, generated on each Python of the lock.

    python benchmarks/pythons.py /somewhere/else --python 3.11 --python 3.12 --python PATH_OF_A_PYTHON

For each Python, uv creates an environment from requirements.lock in that folder, outside of the checkout (8 to 11 GB).
The library is installed as a wheel that is built from the source distribution. The stages from plan to RLDS run without
an importable torch. Plan, physics, frames and RLDS must have equal bytes. The last line is JSON.
"""

import argparse
import hashlib
import json
import os
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from zipfile import ZipFile

import yaml

from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.testset import benchmark

REPOSITORY = Path(__file__).resolve().parent.parent
AXES = ("camera", "light", "background", "noise", "language", "layout", "pose", "robot")
CONFIG = {
    "name": "pythons",
    "demos": {
        "source": "starter",
        "tasks": ["libero_object/pick_up_the_orange_juice_*", "libero_goal/put_the_bowl_on_the_plate"],
    },
    "plan": {"seed": 20261121, "axes": {name: {} for name in AXES}, "episodes": dict.fromkeys(AXES, 1)},
    "replay": {"mode": "auto", "noops": "drop"},
    "render": {"jpeg_quality": 95},
    "export": {"rlds": {"name": "libero_pythons", "shards": 2}, "lerobot": {"name": "libero_pythons", "shards": 2}},
}
WITHOUT_TORCH = ("doctor", "inputs", "plan", "leakage", "replay", "render", "exports")
WITH_TORCH = ("manifest", "recipe", "validate")
"""Stages: all that generate or check data."""

VERSIONS = ("lerobot", "torch", "huggingface-hub", "protobuf", "numpy", "pandas", "pillow")


def environment(folder: Path, python: str, wheel: Path) -> Path:
    """Create an environment of the lock and the library; return its Python."""
    subprocess.run(["uv", "venv", "--quiet", "--clear", "--python", python, folder], check=True)
    there = os.environ | {"VIRTUAL_ENV": str(folder)}
    lock = REPOSITORY / "requirements.lock"
    subprocess.run(["uv", "pip", "sync", "--quiet", "--require-hashes", lock], env=there, check=True)
    subprocess.run(["uv", "pip", "install", "--quiet", "--no-deps", wheel], env=there, check=True)
    return folder / "bin" / "python"


def make(python: Path, folder: Path, testset: Path) -> None:
    """Run all stages in ``folder``, after the commands that need no run."""
    config = folder / "configs" / "pythons.yaml"
    config.parent.mkdir(parents=True)
    config.write_text(yaml.safe_dump(CONFIG))
    (folder / benchmark.FOLDER).parent.mkdir(parents=True)
    (folder / benchmark.FOLDER).symlink_to(testset)
    blocked = folder / "without torch"
    blocked.mkdir()
    (blocked / "torch.py").write_text("raise ImportError('torch is not to be imported here')\n")
    preview = ["-m", "pipeline", "preview", "libero_goal/put_the_bowl_on_the_plate", "camera", str(config)]
    for arguments in (["-m", "pipeline", "--help"], preview):
        subprocess.run([python, *arguments], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    for stages, path in ((WITHOUT_TORCH, str(blocked)), (WITH_TORCH, "")):
        for stage in stages:
            command = [python, REPOSITORY / "stages" / f"{stage}.py", config.relative_to(folder)]
            subprocess.run(command, cwd=folder, env=os.environ | {"PYTHONPATH": path}, check=True)


def contents(data: Path) -> Iterator[tuple[str, str, str]]:
    """Return kind, name and SHA-256 of a run's outputs.

    Stored files count by their arrays alone, as their attributes name the packages.
    """
    yield "plan", "plan.parquet", hashlib.sha256((data / "plan.parquet").read_bytes()).hexdigest()
    for kind in ("trajectories", "frames"):
        for path in sorted((data / kind).rglob("*.npz")):
            with ZipFile(path) as archive:
                for name in archive.namelist():
                    if name.endswith(".npy"):
                        yield kind, f"{path.relative_to(data)}/{name}", hashlib.sha256(archive.read(name)).hexdigest()
    for kind in ("rlds", "lerobot"):
        files = [path for path in (data / kind).rglob("*") if path.is_file()]
        for path in sorted(files):
            yield kind, str(path.relative_to(data)), hashlib.sha256(path.read_bytes()).hexdigest()
    yield "manifest", "manifest.parquet", hashlib.sha256((data / "manifest.parquet").read_bytes()).hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="new folder for environments and runs")
    parser.add_argument("--python", action="append", help="version or path, as for uv; may be repeated")
    arguments = parser.parse_args()
    folder: Path = arguments.folder.resolve()
    folder.mkdir(parents=True)
    subprocess.run(["uv", "build", "--quiet", "--out-dir", folder, REPOSITORY], check=True)
    (wheel,) = folder.glob("*.whl")
    testset = benchmark.fetch_testset(folder / benchmark.FOLDER).parent
    report: dict[str, dict[str, object]] = {}
    made: dict[str, dict[tuple[str, str], str]] = {}
    for number, wanted in enumerate(arguments.python or ["3.11", "3.12", "3.13"]):
        start = time.monotonic()
        python = environment(folder / f"environment-{number}", wanted, wheel)
        installed = time.monotonic()
        run = folder / f"run-{number}"
        make(python, run, testset)
        code = f"import importlib.metadata as m, json, sys; print(json.dumps({{n: m.version(n) for n in {VERSIONS}}}))"
        versions = json.loads(subprocess.run([python, "-c", code], check=True, capture_output=True, text=True).stdout)
        name = subprocess.run([python, "-V"], check=True, capture_output=True, text=True).stdout.strip()
        data = run / "data" / "pythons"
        made[name] = {(kind, path): digest for kind, path, digest in contents(data)}
        seconds = {"install_s": round(installed - start), "run_s": round(time.monotonic() - installed)}
        report[name] = {**versions, **seconds}
        print(name, report[name], flush=True)
    first = next(iter(made.values()))
    compared = Counter(kind for kind, _ in first)
    differing: set[tuple[str, str]] = set()
    for files in made.values():
        differing |= {key for key in files.keys() | first.keys() if files.get(key) != first.get(key)}
    different = sorted(differing)
    for kind, path in different:
        print("differs:", kind, path)
    counts = Counter(kind for kind, _ in different)
    counted = {kind: counts[kind] for kind in compared}
    print(json.dumps({"pythons": report, "compared": compared, "different": counted}))
    raise SystemExit(bool(different))


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
