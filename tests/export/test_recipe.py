"""Recipes: every shipped one reads, every mistake is named."""

from typing import get_args, get_type_hints

import pytest

from hcnaf_export.recipe import (
    from_plain,
    parse_recipe,
    read_recipe,
    shipped,
    to_plain,
    to_toml,
)
from hcnaf_runtime.errors import RecipeError

MINIMAL = 'task = "pom"\nname = "n"\nabout = "a"\n[optimiser]\nsteps = 10\n'


def test_the_recipes_of_the_issue_are_shipped():
    assert set(shipped()) >= {"pom-sim", "pom-tiny", "toy1", "toy2"}


@pytest.mark.parametrize("name", shipped())
def test_a_recipe_survives_toml_and_plain_data(name):
    recipe = read_recipe(name)
    assert recipe.name == name
    assert recipe.task in get_args(get_type_hints(type(recipe))["task"])
    assert parse_recipe(to_toml(recipe)) == recipe
    assert from_plain(to_plain(recipe)) == recipe


def test_a_recipe_is_read_from_a_path(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(MINIMAL + "batch = 7\n[model.crop]\nahead = 40.0\n", encoding="utf-8")
    recipe = read_recipe(path)
    assert recipe.optimiser.batch == 7
    assert recipe.model.crop.ahead == 40.0


def test_a_string_with_quotes_and_newlines_survives():
    recipe = parse_recipe(MINIMAL.replace('"a"', r'"a \"b\"\n\\ ü"'))
    assert parse_recipe(to_toml(recipe)) == recipe


@pytest.mark.parametrize(
    ("text", "key", "known"),
    [
        ("epochs = 3\n" + MINIMAL, "'epochs'", "optimiser"),
        (MINIMAL + "lr = 0.1\n", "'optimiser.lr'", "learning_rate"),
        (MINIMAL + "[model]\nlayers = 2\n", "'model.layers'", "trunk"),
        (MINIMAL + "[model.flow]\nwidth = 2\n", "'model.flow.width'", "hidden"),
        (MINIMAL + "[model.crop]\nfront = 2.0\n", "'model.crop.front'", "ahead"),
        (MINIMAL + "[windows]\nhorizon = 2.0\n", "'windows.horizon'", "horizons"),
    ],
)
def test_an_unknown_key_is_named_with_the_known_ones(text, key, known):
    with pytest.raises(RecipeError, match=key) as caught:
        parse_recipe(text, "own.toml")
    assert known in str(caught.value)
    assert str(caught.value).startswith("own.toml")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("task = ", "not TOML"),
        ("", "task is None"),
        (MINIMAL.replace("pom", "toy9"), "toy9"),
        (MINIMAL.replace("steps = 10", "steps = 0"), "at least 1"),
        (MINIMAL.replace("steps = 10", "steps = 'ten'"), "int"),
        (MINIMAL.replace("steps = 10", ""), "steps"),
        (MINIMAL + "[model.flow]\nlayers = 0\n", "at least 1"),
        (MINIMAL + "[model.flow]\nsupport = 'other'\n", "support"),
        (MINIMAL + "[model]\nflow = 3\n", "flow"),
    ],
)
def test_an_impossible_setting_is_one_line(text, part):
    with pytest.raises(RecipeError, match=part) as caught:
        parse_recipe(text)
    assert "\n" not in str(caught.value)


def test_a_missing_recipe_lists_the_shipped_ones(tmp_path):
    with pytest.raises(RecipeError, match="pom-sim"):
        read_recipe(tmp_path / "none.toml")


def test_a_recipe_is_written_with_the_settings_it_left_out():
    text = to_toml(parse_recipe(MINIMAL))
    for setting in ("max_actors = 4", "weight_norm = ", "ahead = 80.0", "draws = 2", "trunk = [128, 64]"):
        assert setting in text
