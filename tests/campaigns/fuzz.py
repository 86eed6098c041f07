"""Campaign that feeds damaged and hostile files to all readers of files.

    python tests/campaigns/fuzz.py [--cases 1000] [--seed 0] [--kinds plan recording ...]

Each case changes a real file at random, by its own random key, and reads it as the project does. A case passes if the
reader returns the written values, or raises a `PipelineError`, which names the file. All other outcomes are faults: a
different error, a crash of the process, a hang, different values, or a file outside of the case's folder. Cases run in
separate processes; a crash costs only one case. The last line is JSON.
"""

import argparse
import json
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

if __name__ == "__main__":  # run as a script: with what the tests share
    sys.path[:0] = [str(Path(__file__).parents[1])]


import numpy as np
from checkout import REPOSITORY
from episode_results import result
from PIL import Image
from short_demonstrations import STOVE, starter_demo
from synthetic import write_rlds

from pipeline.axes.language import BANK_FILE, load_bank
from pipeline.catalogue.texture_sources import from_file
from pipeline.config import DemosConfig, PlanConfig, RenderConfig, ReplayConfig, load
from pipeline.errors import PipelineError
from pipeline.evaluation.actions import checked_actions
from pipeline.evaluation.results import EpisodeFiles
from pipeline.evaluation.tasks import libero_task
from pipeline.files import read_json
from pipeline.formats.tfrecord import records
from pipeline.libero import bddl, hdf5
from pipeline.libero.assets import relocate
from pipeline.libero.demonstrations import HDF5Source
from pipeline.libero.starts import recorded_start
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.planning import plan
from pipeline.run import manifest
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.trajectory_store import TrajectoryStore
from pipeline.tables import write_table
from pipeline.testset.benchmark import TestSet
from pipeline.types import Jpeg, Rendered, Scene, Trajectory, Verdict

LIMIT_S = 20
"""Time limit of a case; a longer case counts as a hang."""

CHUNK = 25
"""Number of cases in one process."""


@dataclass(frozen=True)
class Kind:
    """Kind of file.

    Attributes:
        name: name of the file in a case's folder.
        make: returns the content of a good file.
        read: reads a file; it must return equal values for a good file each time.
        exact: a changed file must be rejected or give equal values. If false, any values pass: people write such a
            file, and a changed file may be good too.
        text: the file is changed word by word too.
    """

    name: str
    make: Callable[[], bytes]
    read: Callable[[Path], object]
    exact: bool = True
    text: bool = False


def changed(content: bytes, text: bool, rng: random.Random) -> bytes:
    """Apply one to three random changes to a file."""
    ways: list[Callable[[bytes, random.Random], bytes]] = [_flip, _cut, _zero, _repeat, _insert]
    if text:
        ways += [_extreme, _extreme, _extreme, _drop_line, _swap_lines]
    for _ in range(rng.choice((1, 1, 2, 3))):
        content = rng.choice(ways)(content, rng)
    return content


def _flip(content: bytes, rng: random.Random) -> bytes:
    damaged = bytearray(content)
    if damaged:
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def _cut(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.choice((0, 1, len(content) // 2, rng.randrange(len(content) + 1)))]


def _zero(content: bytes, rng: random.Random) -> bytes:
    start, length = rng.randrange(len(content) + 1), rng.choice((1, 8, 512, 4096))
    return content[:start] + bytes(len(content[start : start + length])) + content[start + length :]


def _repeat(content: bytes, rng: random.Random) -> bytes:
    start, length = rng.randrange(len(content) + 1), rng.choice((1, 16, 1024))
    return content[: start + length] + content[start:]


def _insert(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content) + 1)
    return content[:start] + rng.randbytes(rng.choice((1, 4, 64))) + content[start:]


NUMBERS = ("0", "-1", "1e300", "-1e300", "nan", ".nan", "inf", ".inf", "1e-320", "9223372036854775808", "10" * 40)
WORDS = ("null", "true", "''", "'\x00'", "[]", "{}", "{{", "%(a)s", "\ud7ff", "x" * 10_000)
HOSTILE = ("../../../etc/passwd", "/etc/passwd", "*x", "!!python/name:os.system", "$(touch pwned)", "; touch pwned")
EXTREMES = (*NUMBERS, *WORDS, *HOSTILE)
"""Replacements of a word or a number."""


def _extreme(content: bytes, rng: random.Random) -> bytes:
    words = list(re.finditer(rb"[\w.+-]+", content))
    if not words:
        return content
    word = rng.choice(words)
    return content[: word.start()] + rng.choice(EXTREMES).encode() + content[word.end() :]


def _drop_line(content: bytes, rng: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    if lines:
        del lines[rng.randrange(len(lines))]
    return b"".join(lines)


def _swap_lines(content: bytes, rng: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    if len(lines) < 5:
        rng.shuffle(lines)
    else:
        target = rng.randrange(len(lines))
        line = lines.pop(rng.randrange(len(lines)))
        lines.insert(target, line)
    return b"".join(lines)


def _in_temporary(write: Callable[[Path], Path]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return write(Path(folder)).read_bytes()


def _configuration() -> bytes:
    return (REPOSITORY / "configs" / "full.yaml").read_bytes()


@cache
def _rows() -> list[plan.Row]:
    entries = DemosConfig(tasks=("libero_goal/*",)).index().entries
    wanted = PlanConfig.model_validate({"seed": 1, "axes": {"noise": {}}, "episodes": {"noise": 20}})
    return plan.make(entries, wanted, ReplayConfig(), TestSet(()))


def _plan() -> bytes:
    def write(folder: Path) -> Path:
        plan.write(_rows(), folder / "plan.parquet")
        return folder / "plan.parquet"

    return _in_temporary(write)


def _manifest() -> bytes:
    import pyarrow as pa

    def write(folder: Path) -> Path:
        rows = [{**vars(row), "kept": True, "reason": "kept", "chosen": True} for row in _rows()]
        write_table(pa.Table.from_pylist(rows, schema=manifest.schema()), folder / "manifest.parquet")
        return folder / "manifest.parquet"

    return _in_temporary(write)


def _arrays(steps: int, *widths: int) -> list[np.ndarray[Any, np.dtype[np.float64]]]:
    rng = np.random.default_rng(0)
    return [rng.uniform(-1, 1, (steps, width)) for width in widths]


def _trajectory() -> bytes:
    def write(folder: Path) -> Path:
        states, actions = _arrays(21, 79, 7)
        alpha = np.zeros((21, 5), np.float32)
        store = TrajectoryStore(folder)
        store.save(
            Trajectory(
                "0" * 16,
                "open_loop",
                Scene("<mujoco/>", states[0]),
                states,
                actions[:20],
                alpha,
                Verdict(True, "kept"),
            )
        )
        return store.path("0" * 16)

    return _in_temporary(write)


def _read_trajectory(file: Path) -> object:
    loaded = vars(TrajectoryStore(file.parent).load(file.stem))
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in loaded.items()}


def _frames() -> bytes:
    def write(folder: Path) -> Path:
        state, joints, action = (values.astype(np.float32) for values in _arrays(20, 8, 7, 7))
        store = FrameStore(folder, RenderConfig())
        streams = {
            "one": [Jpeg(bytes([n]) * 200) for n in range(20)],
            "two": [Jpeg(bytes([n]) * 90) for n in range(20)],
        }
        store.save(
            "0" * 16, Rendered("open_loop", state, joints, action, action, streams, {"three": "too_dark"}), "llvmpipe"
        )
        (name,) = store.names()
        return store.path(name)

    return _in_temporary(write)


def _read_frames(file: Path) -> object:
    loaded = FrameStore(file.parent.parent, RenderConfig()).load(file.parent.name, ["one", "two"])
    return [loaded.streams, loaded.rejected, loaded.replay_mode, loaded.state.tolist(), loaded.action.tolist()]


def _shard() -> bytes:
    return _in_temporary(lambda folder: max(write_rlds(folder).folder.rglob("*.tfrecord-*")))


def _record() -> bytes:
    return _in_temporary(lambda folder: write_rlds(folder).record_file)


def _read_record(file: Path) -> object:
    from pipeline.formats.rlds import Rlds, RldsConfig

    return Rlds(file.parent, RldsConfig(name="libero_tiny", shards=1)).record()


def _result() -> bytes:
    return json.dumps(asdict(result(libero_task(STOVE, 0), episode="a"))).encode()


@cache
def _model_xml() -> str:
    from pipeline.physics.environment import environment_of

    return environment_of(STOVE).place_fixtures(0)


def _recording() -> bytes:
    def write(folder: Path) -> Path:
        demo = starter_demo(STOVE)
        states = np.tile(demo.init_state, (20, 1))
        first = hdf5.Recording(demo.actions[:20], states, states[:, :9], _model_xml(), {})
        second = hdf5.Recording(demo.actions[1:21], states, states[:, :9], _model_xml(), {})
        file = folder / f"{STOVE.name}_demo.hdf5"
        hdf5.write(file, STOVE, [first, second])
        return file

    return _in_temporary(write)


def _read_recording(file: Path) -> object:
    folder = file.parent / STOVE.suite
    folder.mkdir()
    file.rename(folder / f"{STOVE.name}_demo.hdf5")
    source = HDF5Source(file.parent)
    return [source.load(entry.demo_id).sha256 for entry in source.index([STOVE]).entries]


def _read_model(file: Path) -> object:
    """Read a model as a replay does: relocate it, compile it with MuJoCo, and step it."""
    from pipeline.errors import RejectedError
    from pipeline.physics.environment import environment_of

    try:
        text = file.read_text()
    except UnicodeDecodeError as error:
        raise PipelineError("not UTF-8", where=file) from error
    environment = environment_of(STOVE)
    environment.restore(recorded_start(starter_demo(STOVE), relocate(text, str(file))))
    try:
        environment.step(np.zeros(7))
    except RejectedError as error:
        raise PipelineError(error.reason, where=file) from error
    return None


def _image() -> bytes:
    def write(folder: Path) -> Path:
        pixels = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
        Image.fromarray(pixels).save(folder / "image.png")
        return folder / "image.png"

    return _in_temporary(write)


def _read_answer(file: Path) -> object:
    """Read a model server's answer in msgpack's format."""
    import msgpack

    try:
        answer = msgpack.unpackb(file.read_bytes(), strict_map_key=False)
    except Exception as error:  # the connection's error, not ours
        raise PipelineError(f"not msgpack ({error})", where=file) from error
    return checked_actions(answer, str(file)).tolist()


def _answer() -> bytes:
    import msgpack

    packed: bytes = msgpack.packb(_arrays(8, 7)[0].tolist())
    return packed


KINDS = {
    "configuration": Kind("full.yaml", _configuration, load, exact=False, text=True),
    "plan": Kind("plan.parquet", _plan, plan.read),
    "manifest": Kind("manifest.parquet", _manifest, manifest.read),
    "trajectory": Kind("trajectory.npz", _trajectory, _read_trajectory),
    "frames": Kind("frames.npz", _frames, _read_frames),
    "record": Kind("rlds.json", _record, _read_record, exact=False, text=True),
    "report": Kind(
        "counts.json", lambda: b'{"camera": {"libero_goal": {"kept": 3}}}', read_json, exact=False, text=True
    ),
    "shard": Kind("a.tfrecord-00000-of-00001", _shard, lambda file: list(records(file)), exact=False),
    "recording": Kind("recording.hdf5", _recording, _read_recording, exact=False),
    "model": Kind("model.xml", lambda: _model_xml().encode(), _read_model, exact=False, text=True),
    "definition": Kind("task.bddl", STOVE.bddl_file.read_bytes, lambda f: bddl.read(f), exact=False, text=True),
    "rewrites": Kind("bank.yaml", BANK_FILE.read_bytes, load_bank, exact=False, text=True),
    "texture": Kind("image.png", _image, lambda f: from_file("own", f, "").load().shape, exact=False),
    "result": Kind("a.json", _result, lambda f: list(EpisodeFiles(f.parent.parent).rows()), exact=False, text=True),
    "answer": Kind("answer", _answer, _read_answer, exact=False),
}


class HungError(Exception):
    """Error of a case that exceeds the time limit."""


def _hung(number: int, frame: object) -> None:
    raise HungError


def run_cases(kind: str, numbers: Iterable[int], seed: int, report: Callable[[dict[str, Any]], None]) -> None:
    """Run cases of a kind in this process; ``report`` gets a line before and a line after each case."""
    subject = KINDS[kind]
    content = subject.make()
    signal.signal(signal.SIGALRM, _hung)
    with tempfile.TemporaryDirectory() as temporary:
        expected = _outcome(subject, Path(temporary) / "good" / "episodes", content)
        if expected[0] != "read":
            raise RuntimeError(f"{kind}: the good file is not read: {expected}")
        for number in numbers:
            report({"kind": kind, "case": number})
            rng = random.Random(f"{seed} {kind} {number}")
            folder = Path(temporary) / str(number) / "episodes"
            outcome, value = _outcome(subject, folder, changed(content, subject.text, rng))
            if outcome == "read" and subject.exact and value != expected[1]:
                outcome, value = "other values", None
            report({"kind": kind, "case": number, "outcome": outcome, "detail": str(value)[:300] if value else ""})


def _outcome(subject: Kind, folder: Path, content: bytes) -> tuple[str, Any]:
    folder.mkdir(parents=True)
    file = folder / subject.name
    file.write_bytes(content)
    signal.alarm(LIMIT_S)
    try:
        return "read", subject.read(file)
    except PipelineError as error:
        return "refused", str(error)
    except HungError:
        return "hang", None
    except BaseException as error:
        return "fault", f"{type(error).__name__}: {error}"
    finally:
        signal.alarm(0)


def check(kinds: Iterable[str], cases: int, seed: int) -> tuple[Counter[str], list[str]]:
    """Run ``cases`` cases, spread over the kinds; return the outcomes and the faults."""
    outcomes: Counter[str] = Counter()
    faults: list[str] = []
    listed = list(kinds)
    for place, kind in enumerate(listed):
        left = list(range(cases // len(listed) + (place < cases % len(listed))))
        while left:
            with tempfile.TemporaryDirectory() as folder:
                lines, crash = _in_a_process(kind, left[:CHUNK], seed, Path(folder))
                stray = sorted(path.name for path in Path(folder).iterdir())
                outcomes["files elsewhere"] += len(stray)
            faults += [f"{kind}: wrote {name} into the working folder" for name in stray if name != "MUJOCO_LOG.TXT"]
            done = [line for line in lines if "outcome" in line]
            for line in done:
                outcomes[f"{kind} {line['outcome']}"] += 1
                if line["outcome"] not in ("read", "refused"):
                    faults.append(f"{kind} {line['case']}: {line['outcome']}: {line['detail']}")
            finished = {line["case"] for line in done}
            if crash is not None:
                number = max((line["case"] for line in lines), default=left[0])
                faults.append(f"{kind} {number}: {crash}")
                outcomes[f"{kind} crash"] += 1
                finished.add(number)
            left = [number for number in left if number not in finished]
    return outcomes, faults


def _in_a_process(kind: str, numbers: list[int], seed: int, folder: Path) -> tuple[list[dict[str, Any]], str | None]:
    command = [sys.executable, str(Path(__file__).resolve()), "--seed", str(seed), "--worker", kind, *map(str, numbers)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"kind"')]
    return lines, None if done.returncode == 0 else f"the process ended with {done.returncode}: {done.stderr[-300:]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--worker", nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        kind, *numbers = arguments.worker
        run_cases(kind, map(int, numbers), arguments.seed, lambda line: print(json.dumps(line), flush=True))
        return
    start = time.monotonic()
    outcomes, faults = check(arguments.kinds, arguments.cases, arguments.seed)
    for fault in faults:
        print(fault)
    figures = {"cases": arguments.cases, "seed": arguments.seed, "outcomes": dict(sorted(outcomes.items()))}
    print(json.dumps({**figures, "faults": len(faults), "seconds": round(time.monotonic() - start, 1)}))
    raise SystemExit(bool(faults))


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
