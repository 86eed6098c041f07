"""What holds for all episodes of an evaluation, and what passes in each: what a policy asks to see and answers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, field_serializer

from pipeline.axes.base import Frozen
from pipeline.errors import PipelineError
from pipeline.evaluation import own_draws
from pipeline.evaluation.libero_plus import Prompt
from pipeline.evaluation.selection import Selection
from pipeline.types import Floats

VIEWS = {"agentview": "image", "wrist": "wrist_image"}
"""What policies call the views, to their names in ``schemas/episode.json``."""


class Settings(Frozen):
    """What holds for all episodes of an evaluation.

    Attributes:
        prompt: the wording of test tasks; ``blank`` says nothing in any task.
        black: which views are black, to see what a policy does without them.
        seed: of held-out draws and of noise that is random.
        fixture_seed: of LIBERO's reset, to which the number of the initial state is added. 0 is what OpenVLA uses.
        initial_states: ``libero`` for the states that LIBERO evaluates from, ``demonstration`` for the one that the
            starter set's demonstration of the task begins in, without settling, as when it is replayed for a dataset.
            Test tasks have a state of their own in both, and ``goals`` begin in LIBERO's.
        plan: a plan that held-out draws keep clear of: what is closer than its axis allows is drawn anew. Results name
            it by the SHA-256 of its file.
        look_every: see ``NextLook``; of model servers alone.
    """

    prompt: Prompt | Literal["blank"] = "clean"
    seed: int = 0
    fixture_seed: int = 0
    initial_states: Literal["libero", "demonstration"] = "libero"
    # What came later is left out where it is not used, so that results keep their names.
    black: Literal["none", "agentview", "all"] = Field(default="none", exclude_if=lambda views: views == "none")
    plan: Path | None = Field(default=None, exclude_if=lambda file: file is None)
    look_every: int = Field(default=1, ge=1, exclude_if=lambda steps: steps == 1)

    @field_serializer("plan")
    def _name_by_content(self, plan: Path) -> str:
        return own_draws.sha256_of(plan)


class Wanted(NamedTuple):
    """What a policy asks to see.

    Attributes:
        wrist: the wrist's view beside the agent view.
        state: position, axis-angle and fingers.
        shortest_rotation: the axis-angle with an angle in [0, pi], as vla-eval has it by default; else in [0, 2 pi], as
            robosuite and OpenVLA's data have it.
        images: any view at all; without them nothing is rendered.
    """

    wrist: bool = True
    state: bool = True
    shortest_rotation: bool = False
    images: bool = True


Look = Callable[[Wanted], dict[str, Any]]
"""Gives the observation; frames are rendered when it is called."""


class PolicyError(PipelineError):
    """The policy gave no action: this episode has no result, others may have one."""


def checked_actions(answer: Any, policy: str) -> Floats:
    """(n, 7) what a policy answered, one action or several.

    Raises:
        PolicyError: when it is anything but finite numbers of that shape.
    """
    expected = "(7,) or (n, 7) finite numbers: three of position, three of rotation, and the gripper"
    try:
        actions = np.asarray(answer, np.float64)
    except (TypeError, ValueError) as error:
        raise PolicyError(f"the policy's answer is not numbers ({error})", where=policy, expected=expected) from error
    if actions.ndim not in (1, 2) or actions.shape[-1] != 7 or not actions.size:
        raise PolicyError(f"the policy answers with shape {actions.shape}", where=policy, expected=expected)
    if not np.isfinite(actions).all():
        raise PolicyError("the policy answers with NaN or infinity", where=policy, expected=expected)
    return np.atleast_2d(actions)


def check_settings(selection: Selection, settings: Settings) -> None:
    """Have no episode that says a setting which it does not have.

    Raises:
        PipelineError: when one would, or the plan cannot be read.
    """
    if settings.seed != selection.seed:
        raise PipelineError(
            f"tasks are drawn under seed {selection.seed}, what perturbs them under {settings.seed}",
            where="seed",
            expected="one seed for both",
        )
    if settings.plan is not None:
        own_draws.sha256_of(settings.plan)
        if selection.file is None and selection.source not in ("own", "pairs"):
            raise PipelineError(
                f"{selection.source} has no held-out draws to keep clear of a plan",
                where="plan",
                expected="--source own",
            )
