"""Changes by each of LIBERO-Plus's test tasks, read as text from the wheel with their definitions.

A task's change is stated by its name, by its BDDL file, or by the class that the BDDL file names. Only literals of the
wheel's modules are read, through Python's syntax tree or by pattern; no module is imported.
"""

import ast
import re
import zipfile
from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from pipeline.errors import PipelineError
from pipeline.libero import bddl
from pipeline.libero.bddl import Bddl
from pipeline.libero.tasks import tasks
from pipeline.types import Task

Value = str | int | float

_NAME = re.compile(
    r"(?P<base>.+?)(?:_language_(?P<language>\d+))?"
    r"(?:_view_(?P<view>\d+_\d+_\d+_\d+_\d+)_initstate_(?P<robot>\d+)(?:_noise_(?P<noise>\d+))?"
    r"|_table_(?P<surface>\d+)|_tb_(?P<theme>\d+)|_light_(?P<light>\d+)|_add_(?P<layout>\d+)"
    r"|(?:_moved)?_level(?P<level>\d)_sample(?P<sample>\d))"
)
_LIGHT = re.compile(r".*_([a-z]+)_light_sync_modified_(\d+)")
_BASE_CLASS = re.compile(r"libero_\w*?_manipulation")
_SCENE_FILE = re.compile(r".*_table_(?P<surface>.+?)(?:_bg_(?P<wall>.+))?\.xml")
_NOISE = {
    "motion": ("motion_blur", ("radius_px", "sigma_px")),
    "gaussian_blur": ("gaussian_blur", ("sigma_px",)),
    "zoom": ("zoom_blur", ("max_scale", "copies")),
    "fog": ("fog", ("density", "roughness_decay")),
    "glass": ("glass_blur", ("sigma_px", "delta_px", "passes")),
}
"""Component to the benchmark's function and this project's names of its parameters, in the benchmark's order."""


class SceneFiles(NamedTuple):
    """Files of a test task's arena, as paths below the benchmark's assets.

    Attributes:
        scene_xml: the arena.
        floor, wall: images that LIBERO sets in the arena.
    """

    scene_xml: str
    floor: str
    wall: str


class Reader:
    """Reader of one opened wheel.

    Attributes:
        names: suite to the names of its test tasks.
    """

    def __init__(self, archive: zipfile.ZipFile):
        self._archive = archive
        self.names: dict[str, list[str]] = self._table("benchmark/libero_suite_task_map.py", "libero_task_map")
        self._bases: dict[str, dict[str, Task]] = {}
        for suite in self.names:
            self._bases[suite] = {task.name: task for task in tasks(suite)}
        self._severities = _severities(self._text("envs/env_wrapper.py"))
        self._floors: dict[str, str] = self._table("envs/arenas/style.py", "FLOOR_STYLE")
        self._walls: dict[str, str] = self._table("envs/arenas/style.py", "WALL_STYLE")
        self._classes = dict(self._read_classes())

    def packed(self, path: str) -> bytes:
        """Read a file of the benchmark's package."""
        return self._archive.read(f"liberoplus/liberoplus/{path}")

    def _text(self, path: str) -> str:
        return self.packed(path).decode()

    def _table(self, path: str, name: str) -> Any:
        """Return the literal that a module assigns to ``name``."""
        assignments = [node for node in ast.parse(self._text(path)).body if isinstance(node, ast.Assign)]
        return next(ast.literal_eval(node.value) for node in assignments if ast.unparse(node.targets[0]) == name)

    def _read_classes(self) -> Iterator[tuple[str, dict[str, str]]]:
        """Yield the name of every scene's class, in lower case as the benchmark looks it up, and its styles."""
        for arena in ("tabletop", "kitchen_tabletop", "living_room_tabletop", "study_tabletop", "floor"):
            source = self._text(f"envs/problems/libero_{arena}_manipulation.py")
            _, *parts = re.split(r"^class (\w+)\(", source, flags=re.MULTILINE)
            for name, body in zip(parts[::2], parts[1::2], strict=True):
                styles = re.findall(r'"(scene_xml|floor_style|wall_style)": "([^"]+)"', body)
                yield name.lower(), dict(styles)

    def change(self, suite: str, name: str) -> tuple[str, str, str, str, dict[str, Value]]:
        """Return the fields of a ``TestTask`` after ``suite``.

        They come from the test task's name and, if the name does not state them, from its BDDL file.

        Raises:
            PipelineError: when the name does not follow the benchmark's grammar.
        """
        match = _NAME.fullmatch(name)
        if match is None or match["base"] not in self._bases[suite]:
            raise PipelineError(
                f"the name of the test task {name!r} does not state its change",
                where=suite,
                expected="a name such as turn_on_the_stove_view_0_0_100_2_352_initstate_0",
                remedy="move the folder data/testset to another place: its wheel is fetched again",
            )
        base = self._bases[suite][match["base"]]
        # Each task changes one thing; if a name lists several changes, the others have their neutral values.
        if match["noise"]:
            kind, severity = divmod(int(match["noise"]) - 1, 10)
            component = list(_NOISE)[kind]
            parameters = {"severity": severity + 1, **self._severities[component][severity]}
            return base.name, name, "noise", component, parameters
        if match["language"]:
            _, text = self._heading(suite, f"{base.name}_language_{match['language']}")
            return base.name, name, "language", "rewrite", {"text": text}
        if match["robot"] and int(match["robot"]):
            return base.name, name, "robot", "controller_posture", {"id": int(match["robot"])}
        if match["view"]:
            return base.name, name, "camera", *_camera(*map(int, match["view"].split("_")))
        if match["layout"]:
            return base.name, name, "layout", "objects", _added(self._scene(suite, name))
        if match["level"]:
            moved = _displacement(self._scene(suite, name), bddl.read(base.bddl_file))
            level, sample = int(match["level"]), int(match["sample"])
            return base.name, name, "pose", "pose", {"level": level, "sample": sample, **moved}
        problem, _ = self._heading(suite, name)
        light = _LIGHT.fullmatch(problem)
        if light:
            return base.name, name, "light", "unknown", {"prefix": light[1], "number": int(light[2])}
        component = "theme" if match["theme"] else "surface"
        return base.name, name, "background", component, self._textures(problem, component == "theme")

    def scene_files(self, suite: str, name: str) -> SceneFiles:
        """Return the files of a task's arena; styles that its class lacks come from the class of the arena."""
        problem, _ = self._heading(suite, name)
        styles = self._classes[_BASE_CLASS.match(problem)[0]] | self._classes[problem]  # type: ignore[index]
        floor, wall = self._floors[styles["floor_style"]], self._walls[styles["wall_style"]]
        return SceneFiles(styles["scene_xml"], f"textures/{floor}", f"textures/{wall}")

    @cached_property
    def object_models(self) -> dict[str, str]:
        """Category of an added object, as BDDL files name it, to its MJCF below the benchmark's assets."""
        listed = re.findall(
            r'^class (\w+)\(CustomObjects\):.*?"assets/(new_objects/[^"]+)"',
            self._text("envs/objects/custom_objects.py"),
            flags=re.MULTILINE | re.DOTALL,
        )
        models = {}
        for name, path in listed:
            # LIBERO registers the class BottleOfBabyOil_2 as bottle_of_baby_oil__2.
            words = re.sub("([A-Z0-9])", r" \1", name).split()
            models["_".join(words).lower()] = path
        return models

    def _scene(self, suite: str, name: str) -> Bddl:
        """Parse the BDDL file of a test task."""
        file = f"bddl_files/{suite}/{name}.bddl"
        return bddl.parse(self._text(file), file)

    def _heading(self, suite: str, name: str) -> tuple[str, str]:
        """Return ``problem`` and ``language`` of the BDDL file of a test task."""
        file = f"bddl_files/{suite}/{name}.bddl"
        return bddl.heading(self._text(file), file)

    def _textures(self, problem: str, theme: bool) -> dict[str, Value]:
        """Return arena and image files: of the working surface, and in a theme of the wall too.

        Tables get their image from a scene file that is named after the image. In the floor arena, the working surface
        is the floor itself. In the kitchen and the living room, only the scene files state the image of the wall.
        """
        styles = self._classes[problem]
        scene_file = _SCENE_FILE.fullmatch(styles.get("scene_xml", ""))
        wall = None
        if scene_file:
            surface = f"{scene_file['surface']}.png"
            if scene_file["wall"]:
                wall = f"{scene_file['wall']}.png"
        else:
            surface = self._floors[styles["floor_style"]]
        files: dict[str, Value] = {"arena": bddl.arena(problem), "surface": surface}
        if theme:
            files["wall"] = wall or self._walls[styles["wall_style"]]
        return files


def _camera(azimuth: int, elevation: int, percent: int, yaw: int, pitch: int) -> tuple[str, dict[str, Value]]:
    """Return component and parameters of a view, from its angles in degrees modulo 360 and its distance in percent."""
    angles = {"azimuth_deg": azimuth, "elevation_deg": elevation, "yaw_deg": yaw, "pitch_deg": pitch}
    parameters: dict[str, Value] = {name: (angle + 180) % 360 - 180 for name, angle in angles.items()}
    parameters["distance_scale"] = percent / 100
    if percent != 100:
        component = "distance"
    elif azimuth or elevation:
        component = "spherical"
    else:
        component = "orientation"
    return component, parameters


def _severities(source: str) -> dict[str, list[dict[str, Value]]]:
    """Read the ten rows of parameters of each component, weakest first, from the functions that apply them."""
    functions = {node.name: node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)}
    rows: dict[str, list[dict[str, Value]]] = {}
    for component, (function, names) in _NOISE.items():
        lists = [node for node in ast.walk(functions[function]) if isinstance(node, ast.List)]
        tables = [node for node in lists if len(node.elts) == 10]
        rows[component] = [dict(zip(names, _row(element), strict=True)) for element in tables[0].elts]
    return rows


def _row(element: ast.expr) -> tuple[float, ...]:
    """Read a row of a table of severities.

    A range of magnifications is returned as its greatest value and the number of its values.
    """
    if isinstance(element, ast.Call):
        scales = np.arange(*(ast.literal_eval(argument) for argument in element.args))
        return round(float(scales[-1]), 6), len(scales)
    row = ast.literal_eval(element)
    return row if isinstance(row, tuple) else (row,)


def _added(scene: Bddl) -> dict[str, Value]:
    """Return the objects that were added to a scene: categories, and positions (x, y) in metres in equal order."""
    added = {name: place for name, place in scene.places.items() if "_add_object_region_" in place}
    positions = [scene.regions[place] for place in added.values()]
    return {
        "arena": scene.arena,
        "count": len(added),
        "category": ",".join(scene.objects[name] for name in added),
        "positions": ";".join(f"{x:.4g},{y:.4g}" for x, y in positions),
    }


def _displacement(scene: Bddl, original: Bddl) -> dict[str, Value]:
    """Return the displacements of things from their original places.

    ``moves`` lists every object and fixture as ``name:dx,dy`` in metres. If the goal puts objects somewhere, the first
    of these objects is the ``target``, and ``others`` lists the rest.
    """
    moves = {}
    originals_m = original.centres_m
    for name, (x_m, y_m) in scene.centres_m.items():
        if name in originals_m:
            moves[name] = (round(x_m - originals_m[name][0], 6), round(y_m - originals_m[name][1], 6))
    listed: dict[str, Value] = {"moves": _listed(moves)}
    moved = [name for name in scene.targets if name in moves]
    if not moved:
        return listed
    target, *rest = moved
    dx_m, dy_m = moves[target]
    displacement: dict[str, Value] = {"target": target, "dx_m": dx_m, "dy_m": dy_m}
    if rest:
        displacement["others"] = _listed({name: moves[name] for name in rest})
    return displacement | listed


def _listed(moves: dict[str, tuple[float, float]]) -> str:
    """Write displacements as text, such as ``moka_pot_2:0.01,-0.02;plate_1:0,0.03``."""
    return ";".join(f"{name}:{dx:.6g},{dy:.6g}" for name, (dx, dy) in moves.items())
