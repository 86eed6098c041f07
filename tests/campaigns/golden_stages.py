"""Outputs of the stages after rendering for a few small inputs; ``golden.py`` records them."""

import hashlib
import json
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from short_demonstrations import STOVE
from synthetic import IDS, episode, files, write_format, write_lerobot, write_lerobot_v21, write_rlds

from pipeline.episode_schema import SCHEMA, labels_of
from pipeline.evaluation.environment import EpisodeEnvironment
from pipeline.evaluation.policies import Wanted
from pipeline.evaluation.selection import Selection, select
from pipeline.formats.lerobot.columns import ENCODER, ENCODER_OPTIONS
from pipeline.formats.lerobot.video import planes
from pipeline.formats.read_back import Copy, Statistics, sampled
from pipeline.formats.registry import FORMATS
from pipeline.formats.stated_statistics import DEVIATION, FIGURES, MEAN_LEVELS
from pipeline.images.jpeg import decode
from pipeline.libero.tasks import STEP_LIMITS
from pipeline.report import figures
from pipeline.report.sheets import Tile, sheet, side_by_side, spread
from pipeline.seeding import digest
from pipeline.types import Scene, Trajectory, Verdict
from pipeline.validation import rerender
from pipeline.validation.case import Case
from pipeline.validation.checks import CHECKS, geometry, labels, motion, statistics
from pipeline.validation.checks import pictures as picture_checks

TEMPLATES = ("report.html.j2", "macros.html.j2", "style.css")


def rlds() -> str:
    """Return the digest of all files of a dataset of three shards."""
    return _written(write_rlds)


def lerobot() -> str:
    """Return the digest of all files of two datasets; for videos, of their input and settings.

    A video's bytes are left out, as its encoder may choose its code by the processor.
    """
    return digest(_written(write_lerobot), _written(partial(write_lerobot, frames="images")), _encoded())[:16]


def lerobot_v21() -> str:
    """Return the digest of a v2.1 dataset of each convention, in the same way as ``lerobot``."""
    written = (_written(partial(write_lerobot_v21, convention=each)) for each in ("ipec", "openpi"))
    return digest(*written, _encoded())[:16]


def _encoded() -> str:
    first_frame = planes(decode(episode(IDS[0]).frames["image"][0]))
    return digest(hashlib.sha256(first_frame.tobytes()).hexdigest(), ENCODER, ENCODER_OPTIONS)


def _written(write: Callable[[Path], Any]) -> str:
    with tempfile.TemporaryDirectory() as folder:
        target = write(Path(folder))
        contents = files(target.folder)
    checksums: dict[str, str] = {}
    for name, content in contents.items():
        if not name.endswith(".mp4"):
            checksums[name] = hashlib.sha256(content).hexdigest()
    return digest(checksums)[:16]


def evaluation() -> dict[str, Any]:
    """Return the step limits, and an episode's instruction and observed states at its start and in three steps."""
    (task,) = select(Selection(suites=(STOVE.suite,), tasks=(STOVE.name,)))
    environment = EpisodeEnvironment()
    environment.reset(task)
    seen = [environment.observation(Wanted(images=False))]
    for _ in range(3):
        environment.step([0.5, -0.5, 0.5, 0.1, 0.0, 0.0, 1.0])
        seen.append(environment.observation(Wanted(images=False)))
    environment.close()
    states: dict[str, Any] = {}
    for key in ("states", "controller_states"):
        states[key] = [np.round(observation[key].astype(float), 5).tolist() for observation in seen]
    instructions = {observation["task_description"] for observation in seen}
    return {"step limits": dict(STEP_LIMITS), "told": sorted(instructions), **states}


def checks() -> dict[str, Any]:
    """Return the limits of the checks, and each check to its number of faults in one correct and two faulty copies."""
    made = episode(IDS[0])
    steps = len(made)
    states = np.zeros((steps + 1, 10))
    states[:, 0] = np.arange(steps + 1) / SCHEMA.fps_hz
    states[3:, 0] += 0.01
    states[:-1, 1:8] = made.joint_state
    scene = Scene("", np.zeros(1))
    trajectory = Trajectory(
        *("golden", "open_loop", scene, states, made.action.astype(float)),
        *(np.zeros((steps + 1, 0), np.float32), Verdict(True, "kept")),
    )
    row: dict[str, Any] = {**made.provenance, "suite": STOVE.suite, "task": STOVE.name, "perturbations": "[]"}
    row |= {"kept": True, "steps": steps + 1, "place": 1, "instruction": "task_1"}
    row |= {"actions_sha256": "0", "resolved": "{}", "exceeds_step_limit": True}
    row |= {**labels_of(made), "rewrites": json.dumps(list(made.rewrites))}
    view, second_view = SCHEMA.views
    decoded = {(name, t): decode(made.frames[name][t]) for name, t in product(SCHEMA.views, sampled(steps))}
    swapped = {(view, t): decoded[second_view, t] for t in sampled(steps)}
    negated = {name: replace(seen, intrinsics=-seen.intrinsics) for name, seen in made.geometry.items()}
    marks = {"is_first": np.arange(steps) == 0, "timestamp": np.arange(steps) / SCHEMA.fps_hz}
    stated = {name: row[name] for name in SCHEMA.provenance}
    stored = replace(made, instruction="task_1", provenance=stated, replay=None)
    rewrite = {"role": "user", "style": "task_aug", "timestamp": 0.0, "content": "task_1", "camera": None}
    whole = Copy("whole", stored, ["task_1"] * steps, decoded, marks, {"place": 1})
    wrong = Copy(
        dataset="wrong",
        episode=replace(
            stored,
            action=made.action + np.float32(0.01),
            provenance={},
            frames={},
            geometry=negated,
        ),
        instructions=["something else"] * steps,
        decoded={**decoded, **swapped},
        step_marks={"is_first": np.arange(steps) == 1, "timestamp": np.arange(steps) / 10},
        place={"place": 2},
        persistent_language=[[rewrite]] * steps,
        events=[[{"role": "assistant", "style": "trace", "content": "{}", "camera": "image"}]] * steps,
        statistics=Statistics(
            {"state": {name: [0.5] * 8 for name in FIGURES} | {"count": [1]}},
            {"state": made.state},
            {view: view},
        ),
    )
    blank = replace(wrong, dataset="blank", decoded={place: frame * 0 for place, frame in decoded.items()})
    case = Case(row, made, trajectory, [whole, wrong, blank], None)
    faults = {name: len(list(check.find(case))) for name, check in CHECKS.items()}
    limits: dict[str, float] = {}
    for module in (geometry, labels, motion, picture_checks, statistics):
        limits |= {name: value for name, value in vars(module).items() if isinstance(value, float)}
    limits |= {"fresh PSNR dB": rerender.PSNR_DB, "mean levels": MEAN_LEVELS, "deviation": DEVIATION}
    return {"found": faults, "limits": limits}


def pictures() -> dict[str, str]:
    """Return digests of a contact sheet, a selection of episodes, a plot, and the templates of the report."""
    frames = [decode(episode(IDS[0]).frames[view][0]) for view in SCHEMA.views]
    contact_sheet = sheet("title", [Tile(side_by_side(frames, 64), f"caption {number}") for number in range(5)])
    plot = figures.histogram("title", {"camera": np.linspace(-1, 1, 50)}, np.linspace(-1, 1, 11), "action", log=True)
    rows: list[Mapping[str, Any]] = [
        {"component": n % 2, "suite": n // 10, "level": n % 5, "task": n // 4} for n in range(40)
    ]
    folder = Path(figures.__file__).parent / "templates"
    return {
        "sheet": hashlib.sha256(np.asarray(contact_sheet).tobytes()).hexdigest()[:16],
        "spread": digest([rows.index(row) for row in spread(rows, 16)])[:16],
        "plot": digest(str(plot))[:16],
        "templates": digest([(folder / name).read_text() for name in TEMPLATES])[:16],
    }


STEPS: dict[str, Callable[[], Any]] = {kind.name: partial(_written, partial(write_format, kind)) for kind in FORMATS}
STEPS |= {step.__name__: step for step in (rlds, lerobot, lerobot_v21, evaluation, checks, pictures)}
"""Format or step of ``pipeline.identity.RECIPES`` to the function that returns its output, JSON-serialisable.

A format without a function of its own has the digest of all files of a dataset of six synthetic episodes.
"""
