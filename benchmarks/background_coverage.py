"""Share of each view that new backgrounds cover, in one scene of each of LIBERO's arenas.

    python benchmarks/background_coverage.py

The textures of a component are painted black, then white: the pixels that differ show these textures. The output is
JSON: for each arena and component the share of both views in per cent. `wall, floor` is a theme without its working
surface.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pipeline.axes import RenderPerturbation
from pipeline.axes.background import PARTS, Part, skin_of
from pipeline.episode_schema import SCHEMA
from pipeline.libero.demonstrations import StarterSource
from pipeline.libero.tasks import find_task
from pipeline.machine_code import ensure_fixed_machine_code
from pipeline.physics.environment import Environment
from pipeline.rendering.renderer import Renderer
from pipeline.types import Floats, Frame

if TYPE_CHECKING:
    import mujoco

TASKS = {
    "tabletop": ("libero_goal", "turn_on_the_stove"),
    "kitchen": ("libero_10", "KITCHEN_SCENE3_turn_on_the_stove_and_put_the_moka_pot_on_it"),
    "floor": ("libero_object", "pick_up_the_milk_and_place_it_in_the_basket"),
    "living room": (
        "libero_10",
        "LIVING_ROOM_SCENE2_put_both_the_alphabet_soup_and_the_tomato_sauce_in_the_basket",
    ),
    "study": ("libero_10", "STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy"),
}
COMPONENTS: dict[str, tuple[Part, ...]] = {
    "wall, floor": ("wall", "floor", "cupboard"),
    "theme": PARTS["theme"],
    "surface": PARTS["surface"],
}
NOTICED = 8
"""Smallest difference that counts, in grey levels of any channel; some objects mirror a surface faintly."""


class Painted(RenderPerturbation):
    """Parts of the scene in one grey level."""

    fields: ClassVar[tuple[str, ...]] = ("tex_data",)
    parts: tuple[Part, ...]
    grey: int

    def apply(self, model: mujoco.MjModel) -> None:
        for part in self.parts:
            skin = skin_of(model, part)
            if not skin:
                continue
            start, pixels = model.tex_adr[skin.texture], model.tex_height[skin.texture] * model.tex_width[skin.texture]
            model.tex_data[start : start + pixels * model.tex_nchannel[skin.texture]] = self.grey


def main() -> None:
    figures = {}
    for arena, (suite, name) in TASKS.items():
        task = find_task(suite, name)
        environment = Environment(task)
        renderer = Renderer(environment.place_fixtures(4))
        environment.close()
        state = StarterSource().demonstration(task).init_state
        figures[arena] = {component: shares(renderer, state, parts) for component, parts in COMPONENTS.items()}
        renderer.close()
    print(json.dumps(figures, indent=1))


def shares(renderer: Renderer, state: Floats, parts: tuple[Part, ...]) -> dict[str, float]:
    """Return the share of each view that shows the parts, in per cent."""
    black, white = frames(renderer, state, parts, 0), frames(renderer, state, parts, 255)
    differ = {view: np.abs(black[view].astype(int) - white[view]).max(axis=2) > NOTICED for view in black}
    return {view: round(100 * float(pixels.mean()), 1) for view, pixels in differ.items()}


def frames(renderer: Renderer, state: Floats, parts: tuple[Part, ...], grey: int) -> dict[str, Frame]:
    """Render a frame of each view with the parts painted."""
    with renderer.perturbed([Painted(axis="painted", component="", level=1, parts=parts, grey=grey)]):
        renderer.restore(state, renderer.model.site_rgba[:, 3].astype(np.float32))
        return {name: renderer.frame(view.camera) for name, view in SCHEMA.views.items()}


if __name__ == "__main__":
    ensure_fixed_machine_code()
    main()
