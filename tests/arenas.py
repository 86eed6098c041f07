"""Scene of each of LIBERO's five arenas, and measures of a model for the tests of the render layer."""

import zlib
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cache

import numpy as np
from short_demonstrations import MILK, STOVE, starter_demo

from pipeline.libero.tasks import find_task
from pipeline.physics.environment import Environment
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.software.software_renderer import SoftwareRenderer
from pipeline.types import Floats, Frame

VIEWS = ("agentview", "robot0_eye_in_hand")

TASKS = {
    "tabletop": STOVE,
    "floor": MILK,
    "kitchen": find_task("libero_10", "KITCHEN_SCENE3_turn_on_the_stove_and_put_the_moka_pot_on_it"),
    "living_room": find_task(
        "libero_10", "LIVING_ROOM_SCENE2_put_both_the_alphabet_soup_and_the_tomato_sauce_in_the_basket"
    ),
    "study": find_task("libero_10", "STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy"),
}


@cache
def scene(arena: str) -> tuple[str, Floats]:
    """Return the model of an arena and the first state of a demonstration in it."""
    environment = Environment(TASKS[arena])
    try:
        return environment.place_fixtures(4), starter_demo(TASKS[arena]).init_state
    finally:
        environment.close()


@contextmanager
def both_ways(opened: Renderer) -> Iterator[tuple[SoftwareRenderer, PlainRenderer]]:
    """Yield a renderer's model renderer with savings, and a plain one of its model in a separate context."""
    with closing(opened):
        assert isinstance(opened.model_renderer, SoftwareRenderer)
        with closing(PlainRenderer(opened.model)) as plain:
            yield opened.model_renderer, plain


def renderer(arena: str) -> Renderer:
    """Open a renderer in the state of ``scene``; close it before opening another renderer."""
    model_xml, state = scene(arena)
    made = Renderer(model_xml)
    made.restore(state, made.model.site_rgba[:, 3].astype(np.float32))
    return made


def frames(shown: Renderer, views: Sequence[str] = VIEWS) -> dict[str, Frame]:
    """Render a frame of each view after positions have been computed again for the perturbed model."""
    state = np.concatenate([[shown.data.time], shown.data.qpos, shown.data.qvel])
    shown.restore(state, shown.model.site_rgba[:, 3].astype(np.float32))
    return {view: shown.frame(view) for view in views}


def change(before: Frame, after: Frame) -> float:
    """Return the mean absolute difference in grey levels."""
    return float(np.abs(before.astype(int) - after).mean())


def checksums(shown: Renderer) -> dict[str, int]:
    """Return the checksum of every array of the model."""
    fields = ((name, getattr(shown.model, name)) for name in dir(shown.model) if not name.startswith("_"))
    return {name: zlib.crc32(np.ascontiguousarray(v).data) for name, v in fields if isinstance(v, np.ndarray)}


def changed(before: dict[str, int], after: dict[str, int]) -> set[str]:
    """Return the names of different arrays."""
    return {name for name in before if before[name] != after[name]}
