"""The example in the documentation is a valid scenario and shows the real defaults."""

from __future__ import annotations

from support.paths import ROOT

from kraft.scenario import Planning, Sensing, Trial, Truth, parse_scenario

DOCS = ROOT / "docs" / "scenarios.md"


def example() -> str:
    blocks = DOCS.read_text(encoding="utf-8").split("```yaml\n")
    return next(block.split("```")[0] for block in blocks if "name: warehouse" in block)


def test_the_example_is_valid_and_shows_the_defaults() -> None:
    scene = parse_scenario(example())
    assert scene.planning == Planning(iterations=20_000)
    assert scene.planning.iteration_budget == Planning().iteration_budget
    assert (scene.truth, scene.sensing, scene.trial) == (Truth(), Sensing(), Trial())


def test_the_example_mentions_every_key_of_the_planning_section() -> None:
    text = example()
    assert all(f"{key}:" in text for key in Planning.model_fields)
