"""The report of a run that was really made: complete, true to the manifest, in need of nothing beside itself."""

import base64
import io
import json
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from conftest import REPOSITORY, tiny_config
from html_page import Page, needs_nothing_beside_itself, screenshot
from numpy.typing import NDArray
from PIL import Image

from pipeline.axes import AXES, Perturbation, to_json
from pipeline.axes.report_data import KeptPerturbation, Strips
from pipeline.config import Config, RenderConfig
from pipeline.errors import PipelineError
from pipeline.images.jpeg import encode
from pipeline.images.mp4 import VIDEO_BYTES
from pipeline.libero.tasks import find_task
from pipeline.planning import leakage
from pipeline.report import coverage, figures, pages, report, seen, yields
from pipeline.run import counts, manifest
from pipeline.run.episode_loader import EpisodeLoader
from pipeline.run.run import Run
from pipeline.seeding import rng
from pipeline.testset import benchmark
from pipeline.types import Jpeg, Quality

LIMIT_BYTES = 15_000_000


@pytest.fixture(scope="module")
def config(finished: Path, short_demos: Path) -> Iterator[Config]:
    """The finished run's configuration, from the folder that it was made in."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(finished.parent.parent)
        yield Config.model_validate(tiny_config(short_demos))


@pytest.fixture(scope="module")
def html(config: Config) -> str:
    return report.page(Run(config), benchmark.load(REPOSITORY / benchmark.FOLDER))


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


def test_needs_nothing_beside_itself(html: str) -> None:
    needs_nothing_beside_itself(html)
    assert len(html) < LIMIT_BYTES


def _rendered(**values: Any) -> str:
    """The text of a page of a run without episodes, but for what ``values`` have."""
    names = ("yields", "axes", "overall", "lengths", "quality", "worst", "seen", "rewrites", "videos", "shortfalls")
    tables = ("headline", "by_axis", "coverage", "leakage", "sheets", "previews", "versions", "origins")
    empty: dict[str, Any] = {**dict.fromkeys(names, ()), **{name: {} for name in tables}}
    texts = {"name": "tiny", "example": "", "settings": "", "sample": seen.SAMPLE}
    return " ".join(Page(pages.render("report.html.j2", **{**empty, **texts, **values})).text.split())


def test_the_first_line_is_of_this_runs_demonstrations_and_axes() -> None:
    kept = [{"demo_id": name, "demo_origin": "human"} for name in ("a", "b", "b")]
    kept.append({"demo_id": "c", "demo_origin": "expanded"})
    plots = coverage.plot_axis("camera", [], benchmark.load(REPOSITORY / benchmark.FOLDER))
    shown = {axis: (plots, yields.by_level("", [])) for axis in ("camera", "disturbance")}
    text = _rendered(origins=counts.origins(kept, "hdf5"), coverage=shown)
    assert "1 expanded demonstration and 2 recorded demonstrations, replayed and perturbed on the axes camera, " in text
    assert "camera, disturbance; made by" in text
    assert "human" not in text
    assert "2 human demonstrations, replayed; made by" in _rendered(origins=counts.origins(kept[:3], "starter"))


def test_what_was_not_compared_and_not_measured_is_said() -> None:
    pose: dict[str, Any] = {"smallest": None, "clearance": 1.0, "overlaps": 0, "measure": "m", "coverage": {}}
    pose |= {"rows": 55, "not_compared": 53, "test_tasks": 696, "comparisons": 4, "verdict": "disjoint where compared"}
    text = _rendered(leakage={"pose": pose})
    assert "draws not compared test tasks comparisons pose disjoint where compared - 1 0 55 53 696 4" in text
    assert "At most 200 episodes of each axis are measured" in text


def test_links_lead_to_sections_and_to_files_of_the_run(page: Page, finished: Path) -> None:
    ids = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    links = [attributes["href"] for attributes in page.of("a")]
    assert len(links) > 8
    for link in links:
        assert link[1:] in ids if link.startswith("#") else (finished / link).is_file()


def test_numbers_are_those_of_the_manifest(page: Page, finished: Path) -> None:
    rows = manifest.read(finished / "manifest.parquet")
    told = json.loads((finished / "counts.json").read_text())
    words = " ".join(page.text.split())
    for name in ("planned", "replayed", "kept"):
        total = sum(cell[name] for by_suite in told.values() for cell in by_suite.values())
        assert f" {total} {name} " in words
    assert f" {sum(row['steps'] for row in rows if row['kept']):,} steps " in words
    for axis, by_suite in told.items():
        cells = [by_suite[suite] for suite in dict.fromkeys(row["suite"] for row in rows) if suite in by_suite]
        total = {name: sum(cell[name] for cell in cells) for name in ("planned", "kept")}
        shown = " ".join(f"{cell['kept']}/{cell['planned']}" for cell in (*cells, total))
        assert f"{axis} {shown}" in words
    assert words.count("goal_not_reached") == 1
    kept = [row for row in rows if row["kept"]]
    planned = json.loads((finished / "leakage.json").read_text())
    for finding in leakage.covered_by(kept, planned, benchmark.load(REPOSITORY / benchmark.FOLDER)).values():
        assert finding["measure"] in words
        for component, covered in finding["coverage"].items():
            figures = [covered[name] for name in ("smallest", "median", "p90", "largest")]
            shown = " ".join("-" if figure is None else f"{figure:.3g}" for figure in figures)
            assert f"{component.replace('_', ' ')} {shown} {covered['test_tasks']:,}" in words


def test_every_figure_of_quality_has_a_panel_and_what_moved_others_is_shown(page: Page, finished: Path) -> None:
    rows = [row for row in manifest.read(finished / "manifest.parquet") if row["kept"]]
    assert all(each.name in page.text for each in fields(Quality))
    assert all(row[each.name] is not None for row in rows for each in fields(Quality))
    twins = {row["trajectory_id"] for row in rows if row["role"] == "twin"}
    others = [row for row in rows if row["trajectory_id"] not in twins and row["non_target_moved_m"]]
    moved = {row["trajectory_id"]: row["non_target_moved_m"] for row in others}
    assert sorted(re.findall(r"(\d+\.\d) cm ", page.text)) == sorted(f"{100 * far:.1f}" for far in moved.values())


def test_shows_every_picture_and_a_video_of_every_axis_that_can_be_seen(page: Page, finished: Path) -> None:
    pictures = page.of("img")
    assert len(pictures) == len([*finished.glob("sheets/*.png"), *finished.glob("previews/*/*.png")]) > 6
    assert all(picture["alt"] for picture in pictures)
    for picture in pictures:
        assert np.std(np.asarray(Image.open(io.BytesIO(_content(picture["src"]))))) > 20
    videos = [_content(video["src"]) for video in page.of("video")]
    moved = re.findall(r"\d+\.\d cm ", page.text)
    assert len(videos) == 2 + len(moved)  # camera and noise; a rewritten instruction shows in no frame
    assert max(map(len, videos)) <= VIDEO_BYTES


def test_twins_that_are_left_out_are_still_shown(config: Config, finished: Path) -> None:
    rows = manifest.read(finished / "manifest.parquet")
    for row in rows:
        if row["kept"] and row["role"] == "twin":
            row |= {"kept": False, "reason": "left_out"}
    kept = [row for row in rows if row["kept"]]
    videos = report._videos(kept, counts.twins(rows), EpisodeLoader(finished, config.render))
    assert [video.axis for video in videos] == ["camera", "noise"]


def test_a_combination_counts_with_each_of_its_axes() -> None:
    camera, light = _draw("camera", 0), _draw("light", 0)
    columns = dict.fromkeys(("axis", "component", "level", "suite"), "") | {"steps": 9, "chosen": True}
    lost = {**columns, "perturbations": to_json([camera]), "kept": False, "reason": "too_dark"}
    kept = {**columns, "perturbations": to_json([camera, light]), "kept": True, "reason": "kept"}
    table = yields.by_level("", [lost, kept, kept])
    shown = {name.text: cells for name, *cells in table.rows}
    assert shown["camera"][camera.level - 1] == ("2/3", 2 / 3)
    assert shown["light"][light.level - 1] == ("2/2", 1.0)
    assert all(cell == ("-", None) for at, cell in enumerate(shown["light"], 1) if at != light.level)


def test_a_video_has_the_twin_on_the_left_and_waits_for_the_longer() -> None:
    light, dark = (_still(np.full((256, 256, 3), grey, np.uint8)) for grey in (200, 60))
    clip = pages.beside([light] * 20, [dark] * 24 + [light] * 6)
    frames = _video(clip)
    assert frames.shape == (30, 256, 512, 3)
    assert np.abs(frames[:, :, :250] - 200.0).max() < 8
    assert np.abs(frames[:24, :, 262:] - 60.0).max() < 8
    assert np.abs(frames[26:, :, 262:] - 200.0).max() < 8


def test_a_video_of_pure_noise_still_keeps_to_its_size() -> None:
    noise = [_still(rng(1, frame).integers(0, 256, (256, 256, 3)).astype(np.uint8)) for frame in range(60)]
    assert len(_content(pages.beside(noise, noise).video)) <= VIDEO_BYTES


@pytest.mark.parametrize("name", sorted(AXES))
def test_every_axis_has_a_picture_of_where_its_draws_lie(name: str) -> None:
    task = find_task("libero_goal", "put_the_bowl_on_the_plate")
    draws = [KeptPerturbation(task, _draw(name, variant), None) for variant in range(30)]
    shown = coverage.plot_axis(name, draws, benchmark.load(REPOSITORY / benchmark.FOLDER))
    assert shown.panels
    assert f"{len(benchmark.load(REPOSITORY / benchmark.FOLDER).on_axis(name)):,}" in shown.note
    for panel in shown.panels:
        assert panel.svg.startswith("<svg")
        assert figures.colour(name) in panel.svg or "data:image/png" in panel.svg
        assert figures.INK not in panel.svg
    # One with nothing kept, as of an axis whose replays all fail, is drawn as well.
    assert len(coverage.plot_axis(name, [], benchmark.load(REPOSITORY / benchmark.FOLDER)).panels) == len(shown.panels)


def test_noise_stands_between_the_benchmarks_severities() -> None:
    task = find_task("libero_goal", "put_the_bowl_on_the_plate")
    kept = [KeptPerturbation(task, _draw("noise", n), None) for n in range(100)]
    _, (plot,) = AXES["noise"].describe_coverage(kept, benchmark.load(REPOSITORY / benchmark.FOLDER))
    assert isinstance(plot, Strips)
    assert set(plot.rows) == {"motion", "gaussian blur", "zoom", "fog", "glass"}
    for kind, groups in plot.rows.items():
        severities = groups["noise"]
        assert len(severities), kind
        assert np.abs(severities - severities.round()).min() >= 0.25, kind


def test_the_same_data_give_the_same_figure() -> None:
    groups = {"clean": np.arange(9.0), "camera": np.arange(4.0)}
    one, other = (figures.strips("x", {"row": groups}, "m").svg for _ in range(2))
    assert one == other


def test_an_unfinished_run_says_what_to_run(config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PipelineError, match="python -m pipeline run"):
        report.page(Run(config), benchmark.load(REPOSITORY / benchmark.FOLDER))


@pytest.mark.parametrize("width_px", [360, 1200])
def test_a_browser_shows_it(html: str, width_px: int, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(html)
    shown = screenshot(tmp_path / "report.html", width_px, 3000)
    # Something on every screenful, and a margin that nothing runs into.
    assert all(screenful.std() > 5 for screenful in np.split(shown, 5))
    assert shown[400:, -6:].std() < 25


def _draw(name: str, variant: int) -> Perturbation:
    task = find_task("libero_goal", "put_the_bowl_on_the_plate")
    return AXES[name]().sample(rng(3, name, variant), task, variant)


def _content(address: str) -> bytes:
    return base64.b64decode(address.partition(",")[2])


def _still(frame: NDArray[np.uint8]) -> Jpeg:
    return encode(frame, RenderConfig().jpeg_quality)


def _video(clip: pages.Clip) -> NDArray[np.float64]:
    with av.open(io.BytesIO(_content(clip.video))) as file:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]).astype(float)
