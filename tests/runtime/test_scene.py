"""A scene survives its file and refuses everything that is not one, in one line that names the field."""

import os
import zipfile

import numpy as np
import pytest

from hcnaf_runtime import Condition, Scene
from hcnaf_runtime.errors import InputError, SceneError


def _saved(fields, path, **changes):
    """The fields written by plain numpy, as another program would."""
    arrays = {"version": 1, **fields, "channels": np.array(fields["channels"]), **changes}
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def _one_line(error):
    assert "\n" not in str(error.value)


def test_round_trip(fields, tmp_path):
    fields["past"][1, 0] = np.nan
    future = np.zeros((2, 4, 2), np.float32)
    future[0, 1] = np.nan
    scene = Scene(**fields, future=future, stops=np.float32([[1, 2, 3]]), frame="odom")
    scene.save(tmp_path / "s.npz")
    back = Scene.load(tmp_path / "s.npz")
    for name in ("past", "size", "kind", "target", "raster", "origin", "stops", "future"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scene, name))
        assert getattr(back, name).dtype == getattr(scene, name).dtype
    assert (back.channels, back.frame, back.step, back.resolution) == (("left", "shift"), "odom", 0.1, 0.5)


def test_loads_what_plain_numpy_writes(fields, tmp_path):
    few = {name: fields[name] for name in ("past", "size", "kind", "target", "step")}
    np.savez(tmp_path / "s.npz", version=1, **few)
    scene = Scene.load(tmp_path / "s.npz")
    assert scene.raster.shape == (0, 0, 0)
    assert scene.future is None
    np.testing.assert_allclose(scene.pose, [[3, -2, 0.7], [10, 5, -1.2]], atol=1e-6)


def test_fortran_order_is_read(fields, tmp_path):
    path = _saved(fields, tmp_path / "s.npz", past=np.asfortranarray(fields["past"]))
    np.testing.assert_array_equal(Scene.load(path).past, fields["past"])


def test_is_frozen_and_apart_from_the_callers_arrays(fields):
    scene = Scene(**fields)
    fields["past"][:] = 0
    assert scene.past[0, -1, 4] == 5
    with pytest.raises(ValueError, match="read-only"):
        scene.past[0] = 0


def _changed(name, index, value):
    def change(fields):
        fields[name][index] = value

    return change


def _replaced(**values):
    return lambda fields: fields.update(values)


BAD = {
    "past float64": (
        _replaced(past=np.zeros((2, 3, 5))),
        r"past is float64 \[2, 3, 5\], expected float32 \[N, T, 5\]",
    ),
    "past shape": (_replaced(past=np.zeros((2, 3, 4), np.float32)), r"past is float32 \[2, 3, 4\]"),
    "past list": (_replaced(past=[[0.0]]), "past is a list, expected a numpy array"),
    "past huge": (_replaced(past=np.zeros((1, 2000, 5), np.float32)), "past has the shape .* at most"),
    "no agents": (_replaced(past=np.zeros((0, 3, 5), np.float32)), "no observed agent"),
    "none observed": (_changed("past", (slice(None), -1), np.nan), "no observed agent"),
    "half a row": (_changed("past", (1, 0, 2), np.nan), r"past\[1, 0\] is .* expected a finite row"),
    "infinite": (_changed("past", (1, 0), np.inf), r"past\[1, 0\]"),
    "target unobserved": (_changed("past", (1, -1), np.nan), r"past\[1, -1\] is NaN"),
    "heading": (_changed("past", (0, 1, 3), 2.0), r"past\[0, 1\] .*sin\(yaw\)"),
    "size zero": (_changed("size", (1, 0), 0.0), r"size\[1, 0\] is 0.0"),
    "size rows": (_replaced(size=np.ones((3, 2), np.float32)), "size has 3 rows"),
    "kind": (_changed("kind", 0, 9), r"kind\[0\] is 9"),
    "target type": (_replaced(target=np.zeros(1, np.float32)), "target is float32"),
    "no target": (_replaced(target=np.zeros(0, np.int64)), "target is empty"),
    "target range": (_changed("target", 0, 7), "target names agent 7, expected 0 to 1"),
    "target twice": (_replaced(target=np.zeros(2, np.int64)), "expected every agent once"),
    "raster type": (_replaced(raster=np.zeros((2, 3, 3), np.uint8)), "raster is uint8"),
    "raster count": (_replaced(channels=("left",)), "raster has 2 channels, channels has 1"),
    "raster empty": (_replaced(raster=np.zeros((2, 0, 3), np.int8)), "at least one pixel"),
    "channel twice": (_replaced(channels=("left", "left")), "names 'left' twice"),
    "channels str": (_replaced(channels="left"), "channels is not a list"),
    "origin": (_replaced(origin=np.float32([np.nan, 0])), r"origin\[0\]"),
    "resolution": (_replaced(resolution=0.0), "resolution is 0.0"),
    "step": (_replaced(step=-0.1), "step is -0.1"),
    "step type": (_replaced(step="fast"), "step is a str"),
    "stops": (_replaced(stops=np.float32([[0, np.inf, 0]])), r"stops\[0, 1\]"),
    "frame": (_replaced(frame=3), "frame is a int"),
    "future rows": (_replaced(future=np.zeros((1, 2, 2), np.float32)), "future has 1 rows"),
    "future half": (_replaced(future=np.float32([[[0, np.nan]], [[0, 0]]])), r"future\[0, 0\]"),
}


@pytest.mark.parametrize("name", BAD)
def test_refuses_bad_values(name, fields):
    change, message = BAD[name]
    change(fields)
    with pytest.raises(SceneError, match=message) as error:
        Scene(**fields)
    _one_line(error)


@pytest.mark.parametrize("name", ["past float64", "past huge", "raster type", "target unobserved", "no target"])
def test_refuses_bad_files_by_name(name, fields, tmp_path):
    change, message = BAD[name]
    change(fields)
    path = _saved(fields, tmp_path / "s.npz")
    with pytest.raises(SceneError, match=message) as error:
        Scene.load(path)
    _one_line(error)
    assert str(path) in str(error.value)


def test_refuses_another_version(fields, tmp_path):
    path = _saved(fields, tmp_path / "s.npz", version=2, new_field=np.zeros(3))
    with pytest.raises(SceneError, match=r"scene version 2, only 1 is read; update"):
        Scene.load(path)
    with pytest.raises(SceneError, match="no field 'version'"):
        Scene.load(_saved(fields, tmp_path / "t.npz", version=None))


def test_refuses_unknown_and_missing_fields(fields, tmp_path):
    with pytest.raises(SceneError, match="field 'speed' is unknown"):
        Scene.load(_saved(fields, tmp_path / "s.npz", speed=np.zeros(3)))
    with pytest.raises(SceneError, match="field 'size' is missing"):
        Scene.load(_saved(fields, tmp_path / "t.npz", size=None))


def test_refuses_what_is_not_an_npz(fields, tmp_path):
    text, folder = tmp_path / "text.npz", tmp_path / "folder.npz"
    text.write_text("not a scene")
    folder.mkdir()
    other = tmp_path / "other.npz"
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("version.npy", b"nonsense")
    for path in (text, folder, other, tmp_path / "absent.npz"):
        with pytest.raises(SceneError, match=path.name) as error:
            Scene.load(path)
        _one_line(error)


def test_never_unpickles(fields, tmp_path):
    path = _saved(fields, tmp_path / "s.npz", frame=np.array([object], dtype=object))
    with pytest.raises(SceneError, match="'frame' holds pickled objects"):
        Scene.load(path)


def test_refuses_every_truncation(fields, tmp_path):
    whole = _saved(fields, tmp_path / "s.npz").read_bytes()
    for length in range(0, len(whole), 97):
        cut = tmp_path / "cut.npz"
        cut.write_bytes(whole[:length])
        with pytest.raises(SceneError) as error:
            Scene.load(cut)
        _one_line(error)


def test_flipped_bytes_never_escape_as_another_error(fields, tmp_path):
    whole = bytearray(_saved(fields, tmp_path / "s.npz").read_bytes())
    rng = np.random.default_rng(0)
    refused = 0
    for place in rng.integers(0, len(whole), 300):
        damaged = bytearray(whole)
        damaged[place] ^= 0xFF
        (tmp_path / "d.npz").write_bytes(damaged)
        try:
            Scene.load(tmp_path / "d.npz")
        except SceneError:
            refused += 1
    assert refused > 100


def test_limits_hold_before_allocation(fields, tmp_path):
    """A header that claims terabytes is refused from the header alone."""
    path = tmp_path / "s.npz"
    _saved(fields, path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    claim = members["raster.npy"].replace(b"(2, 6, 8)", b"(2, 6000000, 8000000)")
    # The header's length is fixed: take the growth from its padding.
    growth = len(claim) - len(members["raster.npy"])
    members["raster.npy"] = claim.replace(b" " * growth + b"\n", b"\n", 1)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(SceneError, match=r"raster has the shape \[2, 6000000, 8000000\]"):
        Scene.load(path)


def test_saving_is_whole_or_nothing(fields, tmp_path):
    scene = Scene(**fields)
    with pytest.raises(InputError, match="cannot be written"):
        scene.save(tmp_path / "missing" / "s.npz")
    scene.save(tmp_path / "s.npz")
    assert os.listdir(tmp_path) == ["s.npz"]


@pytest.mark.parametrize("values", [np.zeros((2, 3)), np.zeros(3, np.float32), np.zeros((0, 3), np.float32), [1]])
def test_condition_shape(values):
    with pytest.raises(SceneError, match="condition is"):
        Condition(values)


def test_condition_values():
    with pytest.raises(SceneError, match="NaN"):
        Condition(np.float32([[np.nan]]))
    assert Condition(np.float32([[1, 2]])).values.shape == (1, 2)
