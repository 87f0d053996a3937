"""ETH/UCY: windows never span a gap, splits never leak, and the counts are the benchmark's."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from hcnaf_export.data import eth_ucy
from hcnaf_runtime.errors import DataError

DATA = Path(__file__).parents[2] / ".." / "shared" / "data" / "eth_ucy"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the ETH/UCY recordings are not in ../shared/data")


def walk(pedestrian: int, start: int, count: int, speed: float = 0.5) -> np.ndarray:
    frame = start + 10.0 * np.arange(count)
    return np.stack([frame, np.full(count, pedestrian), speed * frame / 10.0, np.full(count, pedestrian)], axis=1)


def write(folder: Path, rows: np.ndarray) -> None:
    text = "\n".join("\t".join(str(v) for v in row) for row in rows) + "\n"
    for name in eth_ucy.RECORDINGS:
        with gzip.open(folder / f"{name}.txt.gz", "wt") as file:
            file.write(text)


@pytest.mark.parametrize(("count", "expected"), [(0, 0), (1, 0), (19, 0), (20, 1), (21, 2), (50, 31)])
def test_number_of_windows_of_one_pedestrian(count, expected):
    assert len(eth_ucy.windows(walk(1, 0, count), 0)) == expected


def test_windows_are_consecutive_rows_of_one_pedestrian():
    rows = np.concatenate([walk(1, 0, 25), walk(2, 250, 22), walk(3, 40, 19)])
    found = eth_ucy.windows(np.random.default_rng(0).permutation(rows), 4)
    track = np.concatenate([found.history, found.future], axis=1)
    assert track.shape == (6 + 3, 20, 2)
    np.testing.assert_allclose(np.diff(track[..., 0], axis=1), 0.5, atol=1e-5)
    np.testing.assert_array_equal(track[..., 1], np.repeat(found.pedestrian[:, None], 20, axis=1))
    np.testing.assert_allclose(found.history[:, -1, 0], found.frame / 20.0, atol=1e-5)
    assert (found.scene == 4).all()


def test_no_window_spans_a_gap():
    gap = np.concatenate([walk(1, 0, 15), walk(1, 160, 15), walk(1, 10_000, 20)])
    found = eth_ucy.windows(gap, 0)
    assert found.frame.tolist() == [10_070]


def test_splits_share_no_recording(tmp_path):
    write(tmp_path, walk(1, 0, 22))
    for name in eth_ucy.TEST:
        split = eth_ucy.split(tmp_path, name, validation=("uni_examples",))
        parts = [set(part.scene.tolist()) for part in (split.train, split.validation, split.test)]
        assert set.union(*parts) == set(range(8))
        assert sum(len(part) for part in parts) == 8
        assert {eth_ucy.RECORDINGS[i] for i in parts[2]} == set(eth_ucy.TEST[name])
    assert len(eth_ucy.split(tmp_path, "eth").validation) == 0


def test_bad_input_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"no biwi_eth\.txt\.gz"):
        eth_ucy.load(tmp_path)
    write(tmp_path, walk(1, 0, 22))
    with pytest.raises(DataError, match="split 'zara3'"):
        eth_ucy.split(tmp_path, "zara3")
    with pytest.raises(DataError, match="validation on 'biwi_eth'"):
        eth_ucy.split(tmp_path, "eth", validation=("biwi_eth",))
    with pytest.raises(DataError, match="twice in one frame"):
        eth_ucy.windows(np.concatenate([walk(1, 0, 20), walk(1, 0, 20)]), 0)


@pytest.mark.parametrize(
    "content", [b"1 2 three 4\n", b"1 2 3\n", b"1 2 3 4\n1 2\n", b"1 2 nan 4\n", b"\xff\xfe\x00", b""]
)
@pytest.mark.parametrize("packed", [True, False])
def test_bad_files_are_refused(tmp_path, content, packed):
    path = tmp_path / ("biwi_eth.txt.gz" if packed else "biwi_eth.txt")
    path.write_bytes(gzip.compress(content) if packed else content)
    with pytest.raises(DataError, match="biwi_eth"):
        eth_ucy.read_recording(path)


def test_truncated_gzip_is_refused(tmp_path):
    write(tmp_path, walk(1, 0, 50))
    path = tmp_path / "biwi_eth.txt.gz"
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(DataError, match="cannot be read"):
        eth_ucy.read_recording(path)


@needs_data
def test_counts_are_those_of_the_published_benchmark():
    everything = eth_ucy.load(DATA)
    per_recording = np.bincount(everything.scene, minlength=8)
    count = {
        name: sum(int(per_recording[eth_ucy.RECORDINGS.index(r)]) for r in recordings)
        for name, recordings in eth_ucy.TEST.items()
    }
    assert count == {"eth": 364, "hotel": 1197, "univ": 24334, "zara1": 2356, "zara2": 5910}
    step = np.linalg.norm(np.diff(everything.history, axis=1), axis=2)
    assert np.median(step) / eth_ucy.STEP < 2.0
    assert step.max() / eth_ucy.STEP < 10.0
