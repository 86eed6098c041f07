"""Panels for each axis: the parameters of a run next to those of the test tasks, and the distances between them."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from pipeline.axes import AXES
from pipeline.axes.background import BackgroundPerturbation
from pipeline.axes.base import Perturbation
from pipeline.axes.camera import CameraPerturbation
from pipeline.axes.language import distance
from pipeline.axes.language_lint import CLASSES
from pipeline.axes.light import LightPerturbation
from pipeline.axes.noise import NoisePerturbation
from pipeline.axes.pose import PosePerturbation, ScenePerturbation, displacements
from pipeline.axes.robot import RobotPerturbation, benchmark_offsets_rad
from pipeline.libero import bddl
from pipeline.libero.arenas import ARENAS
from pipeline.libero.tasks import find_task
from pipeline.planning import leakage
from pipeline.report.figures import Panel, bars, histogram, scatter, strips
from pipeline.testset.benchmark import TestSet
from pipeline.types import Floats, Task


class Draw(NamedTuple):
    """One perturbation of a kept episode.

    Attributes:
        made: the perturbation.
        resolved: its recorded effect in the scene, `None` without a record.
    """

    task: Task
    made: Any
    resolved: Any


class AxisPlots(NamedTuple):
    """A note on the test set, and the plots of one axis."""

    note: str
    panels: list[Panel]


def plot_axis(axis: str, draws: Sequence[Draw], test: TestSet) -> AxisPlots:
    """Plot the coverage of one axis by its perturbations."""
    plots: dict[str, Callable[[Sequence[Any], TestSet], AxisPlots]] = {
        **{"camera": _camera, "light": _light, "background": _background, "noise": _noise},
        **{"language": _language, "layout": _layout, "pose": _pose, "robot": _robot},
    }
    made: Sequence[Any] = draws if axis in ("language", "layout") else [draw.made for draw in draws]
    axis_plots = plots[axis](made, test) if axis in plots else _numbers(axis, made, test)
    unit = AXES[axis].draws[0].unit
    if unit is None or not test.on_axis(axis):
        return axis_plots
    return AxisPlots(axis_plots.note, [*axis_plots.panels, _distances(axis, draws, test, unit)])


def _distances(axis: str, draws: Sequence[Draw], test: TestSet, unit: str) -> Panel:
    """Plot the distance from each test task to the nearest perturbation.

    Test tasks that cannot be compared with any perturbation are left out.
    """
    least = leakage.distances(axis, [(draw.made, draw.task) for draw in draws], test)
    components = np.array([task.component for task in test.on_axis(axis)])
    rows = {}
    for component in dict.fromkeys(components.tolist()):
        comparable = (components == component) & np.isfinite(least)
        rows[component.replace("_", " ")] = {axis: least[comparable]}
    return strips("from each test task to the nearest draw", rows, unit)


def _numbers(axis: str, draws: Sequence[Perturbation], test: TestSet) -> AxisPlots:
    """Plot an axis without plots of its own: the level and every parameter that is a number."""
    names = [name for name, field in AXES[axis].draws[0].model_fields.items() if field.annotation in (int, float)]
    panels = []
    for name in ("level", *names):
        values = np.array([getattr(draw, name) for draw in draws], float)
        panels.append(strips(name.replace("_", " "), {"draws": {axis: values}}, name))
    return AxisPlots(f"{len(test.on_axis(axis)):,} test tasks.", panels)


def _points(records: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Floats:
    """Collect the named numbers of each record as points (N, len(names))."""
    points = []
    for record in records:
        points.append([float(record[name]) for name in names])
    return np.array(points).reshape(-1, len(names))


def _camera(draws: Sequence[CameraPerturbation], test: TestSet) -> AxisPlots:
    tested = [task.parameters for task in test.on_axis("camera")]

    def points(*names: str) -> dict[str, Floats]:
        """Return distinct points of the test tasks, many of which share a camera, and the perturbations' points."""
        benchmark = np.unique(_points(tested, names), axis=0)
        drawn = np.array([attrgetter(*names)(draw) for draw in draws]).reshape(-1, len(names))
        return {"benchmark": benchmark, "camera": drawn}

    scales = {name: values.ravel() for name, values in points("distance_scale").items()}
    return AxisPlots(
        f"{len(tested):,} test cameras. A draw is a point in each plot; what it leaves alone stays LIBERO's. Where it "
        "lies on a test camera in one plot, it is apart from it in another.",
        [
            scatter("where it stands", points("azimuth_deg", "elevation_deg"), "azimuth (°)", "elevation (°)"),
            strips("how far away", {"scale": scales}, "multiple of the distance"),
            scatter("how it is turned in place", points("yaw_deg", "pitch_deg"), "yaw (°)", "pitch (°)"),
        ],
    )


def _light(draws: Sequence[LightPerturbation], test: TestSet) -> AxisPlots:
    columns = {
        "brightness": ("multiple of the diffuse light", [float(np.mean(p.diffuse_scale_rgb)) for p in draws]),
        "tint": ("saturation", [1 - min(p.diffuse_scale_rgb) / max(*p.diffuse_scale_rgb, 1e-9) for p in draws]),
        "gloss": ("multiple of the specular light", [p.specular_scale for p in draws]),
        "direction": ("lamps tilted by (°)", [p.tilt_deg for p in draws]),
    }
    return AxisPlots(
        f"{len(test.on_axis('light')):,} test tasks, whose values are unknown offline: they are published only within "
        f"the benchmark's asset archive. {sum(p.shadows for p in draws)} of {len(draws)} draws cast shadows.",
        [strips(name, {"draws": {"light": np.array(own)}}, label) for name, (label, own) in columns.items()],
    )


def _background(draws: Sequence[BackgroundPerturbation], test: TestSet) -> AxisPlots:
    names = [covering.texture for p in draws for covering in p.coverings]
    tested = test.on_axis("background")
    images = {task.parameters[part] for task in tested for part in ("surface", "wall") if part in task.parameters}
    # Examples of names: procedural:brick/028, metaworld:floor2.png.
    sources = Counter(name.rpartition("/" if "/" in name else ":")[0] for name in names)
    return AxisPlots(
        f"{len(set(names))} different images in {len(draws)} draws. The {len(tested):,} test tasks show {len(images)}; "
        "a run stops where one of them is shared, by name or by content.",
        [bars("images by source and family", sources, "background", "uses")],
    )


def _noise(draws: Sequence[NoisePerturbation], test: TestSet) -> AxisPlots:
    rows = {}
    for component in dict.fromkeys(task.component for task in test.on_axis("noise")):
        of_component = [p for p in draws if p.component == component]
        tested = [task.parameters for task in test.on_axis("noise") if task.component == component]
        severities: Floats = np.unique([float(parameters["severity"]) for parameters in tested])
        at = np.array([])
        if of_component:
            name, clean = of_component[0].effect.strength
            ladder = sorted({(float(parameters["severity"]), float(parameters[name])) for parameters in tested})
            steps, values = np.array([(0.0, float(clean)), *ladder]).T
            at = np.interp([float(getattr(p.effect, name)) for p in of_component], values, steps)
        rows[component.replace("_", " ")] = {"benchmark": severities, "noise": at}
    return AxisPlots(
        f"{len(test.on_axis('noise')):,} test tasks at ten severities of each kind; a draw stands where its strength "
        "would, on the benchmark's scale.",
        [strips("strength by kind", rows, "severity")],
    )


def _language(draws: Sequence[Draw], test: TestSet) -> AxisPlots:
    tested = test.on_axis("language")
    original = {(t.suite, t.base): find_task(t.suite, t.base).instruction for t in tested}
    far = np.array([distance(str(t.parameters["text"]), original[t.suite, t.base]) for t in tested])
    edited = [(draw.made.component, distance(draw.made.text, draw.task.instruction)) for draw in draws]
    rows = {}
    for name in CLASSES:
        shares = [share for component, share in edited if component == name]
        rows[name.replace("_", " ")] = {"language": np.array(shares)}
    every = {"benchmark": far, "language": np.array([share for _, share in edited])}
    label = "share of characters edited"
    return AxisPlots(
        f"{len(tested):,} test instructions, of no stated class. The distance is the share of characters to edit.",
        [
            histogram("distance to the original wording", every, np.linspace(0, 1, 21), label),
            strips("the same by class", rows, label),
        ],
    )


def _layout(draws: Sequence[Draw], test: TestSet) -> AxisPlots:
    tested = [task.parameters for task in test.on_axis("layout")]
    tested_at = []
    for parameters in tested:
        tested_at += [pair.split(",") for pair in str(parameters["positions"]).split(";") if pair]
    placed_at = []
    for draw in draws:
        room = ARENAS[bddl.read(draw.task.bddl_file).arena]
        placed = draw.resolved["objects"] if draw.resolved else ()
        placed_at += [np.array(thing["position_m"][:2]) - [room.surface_x_m, 0.0] for thing in placed]
    categories = {added.category for draw in draws for added in draw.made.objects}
    groups = {"benchmark": np.unique(np.array(tested_at, float).reshape(-1, 2), axis=0), "layout": np.array(placed_at)}
    tested_counts = [float(parameters["count"]) for parameters in tested]
    counts = [len(draw.made.objects) for draw in draws]
    number = {"benchmark": np.array(tested_counts), "layout": np.array(counts, float)}
    return AxisPlots(
        f"{len(tested):,} test tasks. Objects of {len(categories)} categories were added; a run stops where a test "
        "task in the same scene adds one of these.",
        [
            scatter("where objects stand", groups, "x from the surface's centre (m)", "y (m)", equal=True),
            histogram("objects added", number, np.arange(0.5, 7.0), "objects"),
        ],
    )


def _pose(draws: Sequence[PosePerturbation | ScenePerturbation], test: TestSet) -> AxisPlots:
    tested = [task.parameters for task in test.on_axis("pose")]
    targets = _points([parameters for parameters in tested if "dx_m" in parameters], ("dx_m", "dy_m"))
    alone = [p for p in draws if isinstance(p, PosePerturbation)]
    scenes = [p for p in draws if isinstance(p, ScenePerturbation)]

    def to(title: str, tests: Floats, shifts_m: Sequence[tuple[float, float]]) -> Panel:
        groups = {"benchmark": 100 * tests, "pose": 100 * np.array(shifts_m).reshape(-1, 2)}
        return scatter(title, groups, "dx (cm)", "dy (cm)", equal=True)

    panels = []
    if alone:
        turns = {"yaw": {"pose": np.array([p.dyaw_deg for p in alone])}}
        panels.append(to("where the moved object goes", targets, [(p.dx_m, p.dy_m) for p in alone]))
        panels.append(strips("how far it turns", turns, "degrees"))
    if scenes or not alone:
        moved = np.array([shift for p in tested for shift in displacements(p).values()]).reshape(-1, 2)
        shifts_m = [(move.dx_m, move.dy_m) for p in scenes for move in p.moves]
        panels.append(to("where each thing of a scene goes", moved, shifts_m))
    return AxisPlots(
        f"{len(tested):,} test tasks, of which {len(targets):,} move the target, and all of which move everything "
        f"else as well. {len(scenes)} of {len(draws)} draws move the whole scene. Turns are this project's own.",
        panels,
    )


def _robot(draws: Sequence[RobotPerturbation], test: TestSet) -> AxisPlots:
    ids = [int(task.parameters["id"]) - 1 for task in test.on_axis("robot")]
    tested = benchmark_offsets_rad()[ids].reshape(-1, 7)
    offsets = np.array([p.joint_offsets_rad for p in draws]).reshape(-1, 7)
    joints = {f"joint {n + 1}": {"benchmark": np.unique(tested[:, n]), "robot": offsets[:, n]} for n in range(7)}
    norms = {"benchmark": np.linalg.norm(tested, axis=1), "robot": np.linalg.norm(offsets, axis=1)}
    return AxisPlots(
        f"{len(ids):,} test tasks with {len(set(ids))} different offsets.",
        [
            histogram("size of the offset", norms, np.arange(0.025, 0.6, 0.05), "norm (rad)"),
            strips("offset by joint, base to wrist", joints, "rad"),
        ],
    )
