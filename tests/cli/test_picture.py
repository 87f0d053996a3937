import numpy as np
import pytest

from hcnaf_runtime import KINDS, Forecaster, Grid, Scene

pytest.importorskip("matplotlib")

from hcnaf_cli import picture, picture_maps, picture_scenery

HORIZONS = [0.5, 1, 2, 4]


@pytest.fixture
def scene(fields):
    """A map, a stop line, a car that is not forecast, and one that was seen earlier but not now."""
    road = np.full((6, 8), 127, np.int8)
    names = ("left", "shift", "drivable", "junction", "stop_line")
    past = np.concatenate([fields["past"], fields["past"] + np.float32([0, 6, 0, 0, 0])])
    past[3, -1] = np.nan
    fields |= {
        "past": past,
        "size": np.tile(fields["size"], (2, 1)),
        "kind": np.tile(fields["kind"], 2),
        "raster": np.stack([*fields["raster"], road, road // 2, np.eye(6, 8, dtype=np.int8) * 127]),
        "channels": names,
        "future": np.tile(fields["future"], (2, 1, 1)),
    }
    return Scene(**fields)


@pytest.fixture(scope="session")
def forecaster(bundle):
    return Forecaster(bundle, threads=1)


@pytest.fixture
def maps(forecaster, scene):
    return forecaster.pom(scene, Grid(100, 60, 0.5), HORIZONS)


def _masses():
    rng = np.random.default_rng(0)
    return [rng.random((5, 7)), np.eye(4), np.pad([[0.3]], 2), np.full((3, 2), 0.1)]


@pytest.mark.parametrize("mass", _masses())
def test_refining_keeps_the_mass_and_its_centre(mass):
    fine = picture_maps.refine(mass)
    assert fine.shape == tuple((n + 2) * picture_maps.FINER for n in mass.shape)
    assert fine.sum() == pytest.approx(mass.sum())
    for axis in (0, 1):
        coarse = np.average(np.arange(mass.shape[axis]) + 1.5, weights=mass.sum(axis=1 - axis))
        place = (np.arange(fine.shape[axis]) + 0.5) / picture_maps.FINER
        assert np.average(place, weights=fine.sum(axis=1 - axis)) == pytest.approx(coarse)


@pytest.mark.parametrize("mass", _masses())
def test_the_rank_is_the_mass_of_all_cells_at_least_as_likely(mass):
    expected = [[mass[mass >= value].sum() for value in row] for row in mass]
    np.testing.assert_allclose(picture_maps.density_rank(mass), expected)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("mass", _masses())
def test_the_threshold_bounds_the_smallest_region_with_that_share(mass, share):
    level = picture_maps.threshold(mass, share)
    if level is None:
        assert mass.sum() <= share
        return
    assert mass[mass >= level].sum() >= share
    assert mass[mass > level].sum() <= share


def test_true_position_lies_on_the_recorded_path(scene):
    start, first = scene.past[0, -1, :2], scene.future[0, 0]
    np.testing.assert_allclose(picture_scenery.true_position(scene, 0, 0.1), first, rtol=1e-6)
    np.testing.assert_allclose(picture_scenery.true_position(scene, 0, 0.05), (start + first) / 2, rtol=1e-6)
    np.testing.assert_allclose(picture_scenery.true_position(scene, 0, 4.0), scene.future[0, 39], rtol=1e-6)
    assert np.isnan(picture_scenery.true_position(scene, 0, 4.05)).all()
    assert len(picture_scenery.true_path(scene, 0, 2.0)) == 20


def test_the_view_holds_the_agents_and_their_forecasts(scene, maps):
    low, high = picture.view(scene, maps)
    points = np.concatenate([maps.pose[:, :2], scene.future[maps.agents].reshape(-1, 2)])
    points = np.concatenate([points, picture_maps.extent(maps, 0, 3)])
    assert ((points > low) & (points < high)).all()
    assert (high - low).min() >= 40 - 1e-9
    assert (high - low).max() / (high - low).min() <= 2 + 1e-9


def test_both_frames_show_the_same_places(forecaster, scene, maps):
    again = forecaster.pom(scene, Grid(200, 200, 0.5), HORIZONS, "scene")
    for a in range(2):
        turned, straight = (picture_maps.extent(m, a, 3).mean(axis=0) for m in (maps, again))
        np.testing.assert_allclose(turned, straight, atol=1.0)


def _colours(figure):
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)
    return pixels.reshape(-1, 3)


def test_every_layer_is_on_the_picture(scene, maps):
    figure = picture.paint("a $strange_name", scene, maps)
    figure.canvas.draw()
    axes, panel = figure.axes
    assert axes.get_aspect() == 1.0
    assert len(axes.images) == 3 + 2 * len(HORIZONS)  # road, junction, stop lines, and the maps
    labels = [text.get_text() for text in panel.get_legend().get_texts()]
    assert {"road", "junction", "stop line", "others", "where it may be in 0.5 s"} <= set(labels)
    assert {text.get_text() for text in axes.texts} >= {"0", "1"}
    assert "1.0000" in panel.texts[0].get_text()
    assert "where 2 vehicles may be in 0.5, 1, 2 and 4 s" in figure.get_suptitle()
    from matplotlib.colors import to_rgb

    for hue in picture.horizon_hues(len(HORIZONS)):
        assert np.abs(_colours(figure) / 255 - to_rgb(hue)).max(axis=1).min() < 0.02


def test_a_scene_without_map_or_truth(forecaster, fields):
    fields |= {"future": None, "kind": np.full(2, KINDS.index("pedestrian"), np.uint8)}
    fields["stops"] = np.float32([[5, 5, 0.3]])
    bare = Scene(**fields)
    figure = picture.paint("bare", bare, forecaster.pom(bare, Grid(40, 40, 1.0), np.arange(0.25, 4.01, 0.25)))
    labels = [text.get_text() for text in figure.axes[1].get_legend().get_texts()]
    assert not [label for label in labels if "truly" in label]
    assert "2 road users may be in 0.25 to 4 s" in figure.get_suptitle()


@pytest.mark.parametrize("suffix", [".png", ".svg", ".PDF"])
def test_the_command_draws(run, bundle, scene_path, tmp_path, suffix):
    out = tmp_path / f"out{suffix}"
    result = run("forecast", scene_path, "--model", bundle, "--plot", out, "--horizons", "2", "--grid", "60x40@1")
    assert result.exit_code == 0, result.output
    start = {".png": b"\x89PNG", ".svg": b"<?xml", ".PDF": b"%PDF"}[suffix]
    assert out.read_bytes().startswith(start)
