"""Laws of the map rasteriser: areas, places, directions, clipping."""

import sys

import numpy as np
import pytest

from hcnaf_export.data.raster import MAP_CHANNELS, Rasteriser
from hcnaf_runtime.errors import DataError, GridError, MissingExtraError


def canvas(width=120, height=80, resolution=0.5, origin=(-20.0, 5.0)):
    return Rasteriser(origin, resolution, width, height)


def area(image, resolution=0.5):
    return float(image.sum()) * resolution**2


def centroid(image, drawn):
    rows, cols = np.indices(image.shape)
    total = image.sum()
    pixel = np.array([(image * (cols + 0.5)).sum(), (image * (rows + 0.5)).sum()]) / total
    return drawn.origin + drawn.resolution * pixel


@pytest.mark.parametrize("resolution", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("turn", [0.0, 0.3, 1.1])
def test_a_polygon_keeps_its_area_and_place(resolution, turn):
    drawn = canvas(int(60 / resolution), int(40 / resolution), resolution)
    corners = np.array([[-9.0, -4.0], [9.0, -4.0], [9.0, 4.0], [-9.0, 4.0]])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    drawn.polygon("drivable", corners @ rotation.T + [8.0, 24.0])
    image = drawn.channel("drivable")
    # Pillow fills the sub-pixels on the outline too: half a sub-pixel all round.
    assert area(image, resolution) == pytest.approx(18 * 8, abs=0.25 * resolution * (18 + 8) * 2)
    assert centroid(image, drawn) == pytest.approx([8.0, 24.0], abs=0.25 * resolution)


def test_orientation_of_the_corners_does_not_matter():
    corners = np.array([[0.0, 10.0], [12.0, 11.0], [7.0, 30.0]])
    one, other = canvas(), canvas()
    one.polygon("drivable", corners)
    other.polygon("drivable", corners[::-1])
    assert np.array_equal(one.channel("drivable"), other.channel("drivable"))


def test_a_line_has_its_width_and_flat_ends():
    drawn = canvas()
    drawn.polyline("stop_line", [[0.0, 20.0], [20.0, 20.0]], 4.0)
    image = drawn.channel("stop_line")
    assert area(image) == pytest.approx(80.0, rel=0.06)
    column = image[:, 60]
    assert column.sum() * 0.5 == pytest.approx(4.0, abs=0.26)
    assert image[:, : int(19.0 / 0.5)].sum() == 0.0


def test_a_bend_has_no_gap():
    drawn = canvas()
    drawn.polyline("drivable", [[0.0, 10.0], [15.0, 10.0], [15.0, 30.0]], 4.0)
    row, col = int((10.0 - 5.0) / 0.5), int((16.0 + 20.0) / 0.5)
    assert drawn.channel("drivable")[row, col] == 1.0


@pytest.mark.parametrize("yaw", np.linspace(-3.0, 3.0, 7))
def test_direction_is_the_unit_vector_of_travel_on_the_lane_and_zero_off_it(yaw):
    drawn = canvas()
    along = np.array([np.cos(yaw), np.sin(yaw)])
    drawn.lane_direction(np.array([10.0, 25.0]) + np.outer([-8.0, 0.0, 8.0], along), 3.2)
    field = np.stack([drawn.channel("direction_x"), drawn.channel("direction_y")], axis=-1)
    middle = ((np.array([10.0, 25.0]) + 3.0 * along - drawn.origin) / 0.5).astype(int)
    assert field[middle[1], middle[0]] == pytest.approx(along, abs=1e-6)
    rows, cols = np.indices(field.shape[:2])
    points = drawn.origin + 0.5 * (np.stack([cols, rows], axis=-1) + 0.5) - [10.0, 25.0]
    far = np.abs(points @ [-along[1], along[0]]) > 2.4
    assert np.all(field[far] == 0.0)
    assert np.hypot(field[..., 0], field[..., 1]).max() <= 1.0 + 1e-6


def test_opposite_directions_cancel_and_equal_ones_do_not_add_up():
    drawn = canvas()
    line = np.array([[0.0, 20.0], [20.0, 20.0]])
    for _ in range(3):
        drawn.lane_direction(line, 3.0)
    assert drawn.channel("direction_x").max() == pytest.approx(1.0)
    for _ in range(3):
        drawn.lane_direction(line[::-1], 3.0)
    assert np.abs(drawn.channel("direction_x")).max() < 1e-6


def test_a_window_is_the_same_piece_of_a_larger_one():
    large, small = canvas(), canvas(50, 30, origin=(-5.0, 15.0))
    shape = np.array([[-18.0, 8.0], [30.0, 12.0], [12.0, 44.0]])
    for drawn in (large, small):
        drawn.polygon("drivable", shape)
        drawn.polyline("drivable", [[-60.0, 70.0], [60.0, -10.0]], 2.5)
    piece = large.channel("drivable")[20:50, 30:80]
    assert np.array_equal(piece, small.channel("drivable"))


def test_shapes_out_of_sight_and_degenerate_shapes_draw_nothing():
    drawn = canvas()
    drawn.polygon("drivable", [[1e5, 1e5], [1e5 + 5, 1e5], [1e5, 1e5 + 5]])
    drawn.polygon("drivable", [[0.0, 10.0], [5.0, 10.0]])
    drawn.polyline("drivable", [[0.0, 10.0]], 3.0)
    drawn.polyline("drivable", np.zeros((0, 2)), 3.0)
    drawn.lane_direction([[0.0, 10.0], [0.0, 10.0]], 3.0)
    assert not drawn.to_int8().any()


def test_overlaps_keep_the_larger_value_and_int8_is_127_times_it():
    drawn = canvas()
    square = np.array([[0.0, 10.0], [10.0, 10.0], [10.0, 20.0], [0.0, 20.0]])
    drawn.polygon("stop_line", square, 0.75)
    drawn.polygon("stop_line", square + 5.0, 0.5)
    raster = drawn.to_int8()
    assert raster.shape == (len(MAP_CHANNELS), 80, 120)
    assert raster.dtype == np.int8
    at = [int((y - 5.0) / 0.5) for y in (12.0, 17.0, 23.0)], [int((x + 20.0) / 0.5) for x in (2.0, 7.0, 13.0)]
    assert raster[MAP_CHANNELS.index("stop_line")][at].tolist() == [95, 95, 64]


@pytest.mark.parametrize("bad", [(0, 10, 0.5), (10, 0, 0.5), (10, 10, 0.0), (10, 10, np.nan)])
def test_an_empty_window_is_refused(bad):
    width, height, resolution = bad
    with pytest.raises(GridError, match="at least 1 x 1"):
        Rasteriser((0.0, 0.0), resolution, width, height)


@pytest.mark.parametrize("points", [np.zeros((4, 3)), np.zeros(6), [[0.0, np.nan], [1.0, 1.0], [2.0, 0.0]]])
def test_points_of_another_shape_are_refused(points):
    with pytest.raises(DataError, match="finite coordinates"):
        canvas().polygon("drivable", points)


def test_without_pillow_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtraError, match="pip install"):
        canvas().polygon("drivable", [[0.0, 10.0], [5.0, 10.0], [5.0, 15.0]])
