"""Probabilities of regions against draws from a known density, its integrals in float64, and each other."""

from itertools import pairwise

import numpy as np
import pytest
from gaussian_bundle import make_theta
from scipy.stats import norm

from hcnaf_runtime import Condition, Forecaster, Grid, Scene, embedded_scenes, regions
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.regions import box_corners, polygon_probability, rectangle_corners

GAUSSIANS = {
    "wide": (5, 1, 2, 1.5, 0.5),
    "narrow": (0.1, 0.2, 0.1, 0.1, 0.0),
    "narrow diagonal": (0.1, 0.2, 0.1, 0.1, 0.99),
    "narrow diagonal far away": (60.1, 0.2, 0.1, 0.1, 0.99),
    "long ridge": (20, 3, 3, 3, -0.995),
    "thin across": (3.3, 0.7, 0.05, 2, 0.5),
    "thin along": (3.3, 0.7, 3, 0.05, 0.9),
    "very wide": (0, 0, 30, 20, 0.3),
}
DRAWS = 1_000_000


def polygons(name):
    """Convex and other simple polygons about a Gaussian, some of them much larger or smaller: a list of [V, 2]."""
    mx, my, sx, sy, _ = GAUSSIANS[name]
    rng = np.random.default_rng(sorted(GAUSSIANS).index(name))
    shapes = [
        np.array([[0, 0], [4, 0], [4, 4], [2, 1], [0, 4]]) - 2,  # a crown
        np.array([[0, 0], [3, 0], [3, 3], [0, 3], [0, 2], [2, 2], [2, 1], [0, 1]]) - 1.5,  # a horseshoe
        rectangle_corners(np.array([[0.3, -0.2, 0.7, 9.0, 5.0]]))[0],
        rectangle_corners(np.array([[2.0, 1.0, -1.2, 4.6, 0.3]]))[0],
        box_corners(np.array([[-0.5, -1.0, 1.5, 0.4]]))[0],
        _octagon(rng),
        np.array([[-3, -2], [2.5, -0.5], [-1, 3]]),
    ]
    return [np.array([mx, my]) + scale * np.array([sx, sy]) * s for s in shapes for scale in (0.2, 1.0)]


def _octagon(rng):
    angles = np.sort(rng.uniform(0, 2 * np.pi, 8))
    return 2.0 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def stacked(shapes):
    """[1, n, V, 2]: shorter ones repeat their last corner."""
    most = max(len(s) for s in shapes)
    return np.stack([np.concatenate([s, np.repeat(s[-1:], most - len(s), axis=0)]) for s in shapes])[None]


def inside(points, polygon):
    """[n]: by counting the edges to the right of each point."""
    count = np.zeros(len(points), int)
    for (xa, ya), (xb, yb) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crosses = (ya > points[:, 1]) != (yb > points[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            at = xa + (points[:, 1] - ya) / (yb - ya) * (xb - xa)
        count += crosses & (at > points[:, 0])
    return count % 2 == 1


def exact(name, polygon, panels=400):
    """The integral of the density along the polygon's edges (Green's theorem), in float64."""
    mx, my, sx, sy, rho = (float(np.float32(v)) for v in GAUSSIANS[name])
    t, w = np.polynomial.legendre.leggauss(8)
    grid = (np.arange(panels)[:, None] + (t + 1) / 2).ravel() / panels
    total = 0.0
    for (xa, ya), (xb, yb) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        low, high = (min(max(x, mx - 9 * sx), mx + 9 * sx) for x in (xa, xb))
        if low == high:
            continue
        x = low + (high - low) * grid
        y = ya + (x - xa) * (yb - ya) / (xb - xa)
        F = norm.cdf(y, my + rho * sy / sx * (x - mx), sy * np.sqrt(1 - rho**2))
        total -= (np.tile(w / 2 / panels, panels) * F * norm.pdf(x, mx, sx)).sum() * (high - low)
    return total


def _points(name, seed=0):
    mx, my, sx, sy, rho = (float(np.float32(v)) for v in GAUSSIANS[name])
    a, b = np.random.default_rng(seed).normal(size=(2, DRAWS))
    return np.stack([mx + sx * a, my + sy * (rho * a + np.sqrt(1 - rho**2) * b)], axis=-1)


@pytest.mark.parametrize("name", GAUSSIANS)
def test_polygons_against_the_integral(name, forecaster):
    shapes = polygons(name)
    found = polygon_probability(forecaster.flow, make_theta(*GAUSSIANS[name]), stacked(shapes))
    truth = np.array([exact(name, s) for s in shapes])
    truth *= np.sign([_area(s) for s in shapes])
    assert np.abs(found.value[0] - truth).max() < 6e-6
    assert (np.abs(found.value[0] - truth) < found.error[0] + 2e-6).all()
    assert found.error.max() < 3e-4


def _area(polygon):
    (x, y), (u, v) = polygon.T, np.roll(polygon, -1, axis=0).T
    return (x * v - y * u).sum()


@pytest.mark.parametrize("name", ["wide", "narrow diagonal", "thin along"])
def test_polygons_against_a_million_draws(name, forecaster):
    shapes = polygons(name)
    found = polygon_probability(forecaster.flow, make_theta(*GAUSSIANS[name]), stacked(shapes)).value[0]
    points = _points(name)
    for p, shape in zip(found, shapes, strict=True):
        share = inside(points, shape).mean()
        assert abs(p - share) < 4 * np.sqrt(max(p * (1 - p), 1e-6) / DRAWS) + 1e-6


def test_boxes_against_the_sum_of_their_cells(forecaster, scene):
    """Cells are computed another way; boxes end on the edges of some."""
    grid = Grid(120, 80, 0.25).at(-5, -10)
    maps = forecaster.pom(scene, grid, [0.5, 2.0])
    corners = np.sort(np.random.default_rng(0).integers(0, [[120], [80]], (25, 2, 2)), axis=-1)
    corners[..., 1] += 1
    x, y = np.moveaxis(corners, 1, 0) * 0.25 + np.array([-5, -10])[:, None, None]
    boxes = np.stack([x[:, 0], y[:, 0], x[:, 1], y[:, 1]], axis=-1)
    found = forecaster.box_probability(scene, boxes, [0.5, 2.0])
    assert found.value.shape == found.error.shape == (2, 2, 25)
    for k, ((c, d), (r, s)) in enumerate(corners):
        cells = maps.mass[..., r:s, c:d].sum(axis=(2, 3), dtype=np.float64)
        np.testing.assert_allclose(found.value[..., k], cells, atol=1e-5)


def test_corners_go_round_either_way_from_any(forecaster):
    theta = make_theta(*GAUSSIANS["wide"])
    for shape in polygons("wide"):
        same = [np.roll(shape, k, axis=0) for k in range(len(shape))] + [shape[::-1], np.repeat(shape, 2, axis=0)]
        found = polygon_probability(forecaster.flow, theta, stacked(same)).value
        np.testing.assert_allclose(found, found[0, 0], atol=5e-6)


@pytest.mark.parametrize("name", GAUSSIANS)
def test_parts_add_up(name, forecaster):
    """A rectangle, cut by a line, and again at right angles."""
    mx, my, sx, sy, _ = GAUSSIANS[name]
    whole = rectangle_corners(np.array([[mx + 0.3 * sx, my, 0.4, 3 * sx, 2 * sy]]))[0]
    across = [np.stack([whole[0], whole[1] * s + whole[0] * (1 - s)]) for s in (0.0, 0.3, 1.0)]
    side = whole[3] - whole[0]
    parts = [np.array([a[1], b[1], b[1] + side, a[1] + side]) for a, b in pairwise(across)]
    halves = [
        p + 0.5 * k * side * [[1], [1], [0], [0]] - 0.5 * (1 - k) * side * [[0], [0], [1], [1]]
        for p in parts
        for k in (0, 1)
    ]
    found = polygon_probability(
        forecaster.flow, make_theta(*GAUSSIANS[name]), stacked([whole, *parts, *halves])
    ).value[0]
    assert found[1:3].sum() == pytest.approx(found[0], abs=1e-5)
    assert found[3:].sum() == pytest.approx(found[0], abs=1e-5)


@pytest.mark.parametrize("name", GAUSSIANS)
def test_everything_and_nothing(name, forecaster):
    mx, my, sx, sy, _ = GAUSSIANS[name]
    size = 20 * max(sx, sy)
    shapes = [
        rectangle_corners(np.array([[mx, my, 0.3, 2 * size, 2 * size]]))[0],
        rectangle_corners(np.array([[mx + 3 * size, my, 0.3, size, size]]))[0],
        rectangle_corners(np.array([[mx, my - 3 * size, 0.3, size, size]]))[0],
        np.full((4, 2), [mx, my]),
        np.array([[mx - 1, my], [mx + 1, my], [mx - 1, my], [mx + 1, my]]),
    ]
    found = polygon_probability(forecaster.flow, make_theta(*GAUSSIANS[name]), stacked(shapes))
    assert found.value[0, 0] > 1 - 1e-6
    assert found.value[0, 1:].max() < 1e-9
    assert found.error.max() < 4e-6


def test_batch_equals_stacked_singles_and_chunked_equals_whole(forecaster, monkeypatch):
    theta = np.concatenate([make_theta(*values) for values in GAUSSIANS.values()])
    shapes = np.concatenate([stacked(polygons("wide"))] * len(theta))
    together = polygon_probability(forecaster.flow, theta, shapes)
    for b in range(len(theta)):
        alone = polygon_probability(forecaster.flow, theta[b : b + 1], shapes[b : b + 1])
        np.testing.assert_allclose(together.value[b], alone.value[0], atol=8e-6)
    chunked = polygon_probability(forecaster.flow, theta, shapes, chunk=1)
    np.testing.assert_allclose(chunked.value, together.value, atol=8e-6)
    monkeypatch.setattr(regions, "_AT_ONCE", 5)
    few = polygon_probability(forecaster.flow, theta, shapes)
    np.testing.assert_allclose(few.value, together.value, atol=8e-6)


def test_the_tolerance_is_kept(forecaster):
    theta = make_theta(*GAUSSIANS["long ridge"])
    shapes = [s + np.array([dx, 0]) for s in polygons("long ridge") for dx in np.linspace(-4, 4, 9)]
    truth = np.array([exact("long ridge", s) * np.sign(_area(s)) for s in shapes])
    for tolerance in (1e-3, 1e-4, 1e-5):
        found = polygon_probability(forecaster.flow, theta, stacked(shapes), tolerance)
        off = np.abs(found.value[0] - truth)
        assert (off < 3 * tolerance + 1e-6).all()
        assert (off < found.error[0] + 1e-6).mean() > 0.98


def test_the_same_places_in_both_frames(forecaster, scene):
    own = np.random.default_rng(1).uniform(-3, 5, (2, 9, 3, 2))
    placed = []
    for triangles, (x, y, yaw) in zip(own, scene.pose, strict=True):
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        placed.append(triangles @ turn.T + [x, y])
    expected = forecaster.polygon_probability(scene, own, [1.0, 2.0])
    found = forecaster.polygon_probability(scene, np.stack(placed), [1.0, 2.0], "scene")
    np.testing.assert_allclose(found.value, expected.value, atol=5e-6)
    by_horizon = forecaster.polygon_probability(scene, np.repeat(own[:, None], 2, axis=1), [1.0, 2.0])
    np.testing.assert_array_equal(by_horizon.value, expected.value)


def test_a_rectangle_is_a_turned_box(forecaster, scene):
    boxes = np.array([[0.0, -1.0, 4.0, 1.0], [1.0, 0.0, 2.0, 3.0]])
    rectangles = np.array([[2.0, 0.0, 0.0, 4.0, 2.0], [1.5, 1.5, np.pi / 2, 3.0, 1.0]])
    expected = forecaster.box_probability(scene, boxes, [1.0]).value
    np.testing.assert_allclose(
        forecaster.rectangle_probability(scene, rectangles, [1.0]).value, expected, atol=5e-6
    )
    swapped = boxes[:, [2, 3, 0, 1]]
    np.testing.assert_allclose(forecaster.box_probability(scene, swapped, [1.0]).value, expected, atol=5e-6)


def test_a_condition_has_regions_in_its_own_frame(condition_path):
    forecaster = Forecaster(condition_path, threads=1)
    condition = Condition(np.concatenate([make_theta(0, 0, 1, 1, 0), make_theta(1, 0, 1, 2, 0)]))
    found = forecaster.box_probability(condition, np.array([[-1.0, -2.0, 1.0, 2.0]]))
    expected = [
        (norm.cdf(1) - norm.cdf(-1)) * (norm.cdf(2) - norm.cdf(-2)),
        (norm.cdf(0) - norm.cdf(-2)) * (norm.cdf(1) - norm.cdf(-1)),
    ]
    np.testing.assert_allclose(found.value[:, 0, 0], expected, atol=3e-6)
    with pytest.raises(InputError, match="frame"):
        forecaster.box_probability(condition, np.array([[-1.0, -2.0, 1.0, 2.0]]), frame="scene")


def test_parts_add_up_under_the_embedded_model():
    """Densities that are no Gaussians: eight triangles make a square."""
    forecaster, scene = Forecaster(threads=2), Scene.load(embedded_scenes()["junction"])
    angles = np.arange(9) * np.pi / 4
    reach = np.where(np.arange(9) % 2, np.sqrt(2.0), 1.0)[:, None]
    corners = 6.0 * reach * np.stack([np.cos(angles), np.sin(angles)], axis=-1) + [10.0, 1.0]
    middle = np.array([9.0, 0.0])
    triangles = [np.stack([middle, a, b]) for a, b in pairwise(corners)]
    found = forecaster.polygon_probability(scene, stacked([corners[:-1], *triangles])[0], [0.5, 1.0, 2.0, 4.0])
    np.testing.assert_allclose(found.value[..., 1:].sum(axis=-1), found.value[..., 0], atol=1e-5)
    assert found.error.max() < 3e-5


@pytest.mark.parametrize(
    ("polygons", "message"),
    [
        (np.zeros((3, 2, 2)), "at least 3 corners"),
        (np.zeros((3, 4, 3)), "regions"),
        (np.zeros((3, 2, 1, 4, 2)), "regions"),
        (np.zeros((4, 2)), "regions"),
        (np.array([[[0, 0], [1, 0], [0, np.nan]]]), "NaN"),
        (np.array([["a"] * 2] * 3)[None], "regions"),
    ],
)
def test_polygons_that_are_none(forecaster, scene, polygons, message):
    with pytest.raises(InputError, match=message):
        forecaster.polygon_probability(scene, polygons, [1.0])


def test_what_else_is_refused(forecaster, scene):
    with pytest.raises(InputError, match="boxes is float64"):
        forecaster.box_probability(scene, np.zeros((3, 5)))
    with pytest.raises(InputError, match="rectangles is float64"):
        forecaster.rectangle_probability(scene, np.zeros((3, 4)))
    with pytest.raises(InputError, match="tolerance"):
        forecaster.box_probability(scene, np.zeros((3, 4)), tolerance=0.0)
    with pytest.raises(InputError, match="frame"):
        forecaster.box_probability(scene, np.zeros((3, 4)), frame="map")
