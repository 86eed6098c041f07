"""Who made what episodes show is told from the manifest alone, and the sources hold what the README promises."""

from short_demonstrations import MILK

from pipeline.axes import AXES, to_json
from pipeline.axes.background import BackgroundAxis
from pipeline.axes.base import Credit, Perturbation
from pipeline.axes.camera import CameraAxis
from pipeline.axes.layout import LayoutAxis
from pipeline.publish.card import attributions
from pipeline.seeding import rng


def row(*perturbations: Perturbation) -> dict[str, str]:
    """Columns of an episode of the milk, whose arena has no cupboard, and a floor that is worked on."""
    return {"suite": MILK.suite, "task": MILK.name, "perturbations": to_json(perturbations)}


def test_everything_that_is_shown_is_attributed_and_nothing_else() -> None:
    background = BackgroundAxis(components=("theme",)).sample(rng("inventory"), MILK, 0)
    layout = LayoutAxis(levels=(3,)).sample(rng("inventory"), MILK, 0)
    camera = CameraAxis().sample(rng("inventory"), MILK, 0)
    found = attributions([row(layout, background), row(layout), row(camera), row()])
    objects = {made.name: made for made in found if made.kind == "object"}
    assert {added.name for added in layout.objects} == set(objects)
    for added in layout.objects:
        assert added.licence
        assert added.attribution
        assert objects[added.name] == Credit(added.name, "object", added.licence, added.attribution)
        assert found[objects[added.name]] == 2
    textures = {made.name: made for made in found if made.kind == "texture"}
    shown = {covering.texture for covering in background.coverings if covering.part in ("wall", "surface")}
    assert len(background.coverings) == 4
    assert shown == set(textures)
    assert {found[made] for made in textures.values()} == {1}
    assert all(made.licence for made in found)
    assert len(found) == len(objects) + len(textures)


def test_a_texture_on_two_parts_of_a_scene_is_one_episode() -> None:
    perturbation = BackgroundAxis(components=("theme",)).sample(rng("inventory"), MILK, 0)
    same = perturbation.model_copy(update={"coverings": (perturbation.coverings[0],) * 2})
    assert list(attributions([row(same)]).values()) == [1]


def test_what_is_installed_holds_what_the_documentation_says() -> None:
    offered = [axis().offered() for axis in AXES.values()]
    counts = {kind: number for of_axis in offered for kind, number in of_axis.items()}
    assert counts == {"surfaces": 803, "procedural": 780, "models": 58, "categories": 26}
