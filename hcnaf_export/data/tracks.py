"""Track sets: everything that moved in one simulated network; training snippets are windows on it.

    Dataset (directory, dataset.json) ── split ──> TrackSet (one npz) ── window (track, step) ──> Scene

All tracks lie one after the other in arrays of R rows; row `track_start[i] + s - track_step[i]` is track i at
simulation step s. A window is a snippet of 5 s of one track: HISTORY rows up to now, FUTURE rows after it.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hcnaf_export.data.manifest import Manifest as Manifest
from hcnaf_export.data.manifest import NoiseModel as NoiseModel
from hcnaf_export.data.manifest import SetEntry as SetEntry
from hcnaf_export.data.manifest import Split as Split
from hcnaf_export.data.manifest import read_manifest as read_manifest
from hcnaf_runtime.errors import DataError
from hcnaf_runtime.npz import read_npz, write_npz
from hcnaf_runtime.scene import Scene

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

HISTORY = 10
"""History rows of a window, now included (1 s)."""

FUTURE = 40
"""Future rows of a window (4 s)."""

STEP = 0.1
"""Seconds between rows."""

_FORMAT = "hcnaf-tracks-1"
_ARRAYS: dict[str, tuple[type[np.generic], tuple[str | int, ...]]] = {
    "truth": (np.float32, ("R", 4)),
    "observed": (np.float32, ("R", 4)),
    "seen": (np.bool_, ("R",)),
    "label": (np.float32, ("R", 2)),
    "track_start": (np.int64, ("n+1",)),
    "track_step": (np.int32, ("n",)),
    "size": (np.float32, ("n", 2)),
    "kind": (np.uint8, ("n",)),
    "parked": (np.bool_, ("n",)),
    "raster": (np.int8, ("C", "H", "W")),
    "origin": (np.float32, (2,)),
    "stops": (np.float32, ("S", 3)),
    "windows": (np.int32, ("K", 2)),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackSet:
    """Tracks, map and windows of one network. Right-handed network frame, metres, seconds, radians.

    Attributes:
        truth: float32 [R, 4], x, y, yaw, speed of the box centre.
        observed: float32 [R, 4], `truth` as perceived: with the recorded perception noise.
        seen: bool [R], False where the detection was dropped.
        label: float32 [R, 2], true position with the recorded label noise: what forecasts are scored on.
        track_start: int64 [n + 1], rows `track_start[i]` to `track_start[i + 1]` are track i.
        track_step: int32 [n], simulation step of each track's first row.
        size: float32 [n, 2], box length and width.
        kind: uint8 [n], index in `hcnaf_runtime.scene.KINDS`.
        parked: bool [n], stands at the roadside for good.
        raster: int8 [C, H, W], the map, value / 127; row 0 is the lowest y.
        channels: the raster's channel names.
        origin: float32 [2], network coordinates of the raster's lower-left corner.
        resolution: metres per pixel.
        stops: float32 [S, 3], stop lines: x, y, yaw of approaching traffic.
        windows: int32 [K, 2], (track, step of now) of the snippets chosen for training or scoring.
        step: seconds between rows.
        name: what the set is called.

    Raises:
        DataError: an array of another dtype or shape than above, or with indices that do not fit.
    """

    truth: Float32
    observed: Float32
    seen: Bool
    label: Float32
    track_start: Int64
    track_step: NDArray[np.int32]
    size: Float32
    kind: NDArray[np.uint8]
    parked: Bool
    raster: NDArray[np.int8]
    channels: tuple[str, ...]
    origin: Float32
    resolution: float
    stops: Float32
    windows: NDArray[np.int32]
    name: str
    step: float = STEP

    def __post_init__(self) -> None:
        _check_shapes(self)
        _check_indices(self)

    @property
    def count(self) -> int:
        """Number of tracks n."""
        return len(self.track_step)

    @cached_property
    def length(self) -> Int64:
        """int64 [n], rows of each track."""
        return np.diff(self.track_start)

    def agents_at(self, step: int) -> Int64:
        """The tracks present at a simulation step: int64 [m], ascending."""
        first, indptr, tracks = self._by_step
        if not 0 <= step - first < len(indptr) - 1:
            return np.zeros(0, dtype=np.int64)
        return tracks[indptr[step - first] : indptr[step - first + 1]]

    def rows(self, tracks: ArrayLike, steps: ArrayLike) -> Int64:
        """Row numbers of tracks at steps (broadcast), -1 where a track is absent or its index is -1."""
        track, step = np.broadcast_arrays(np.asarray(tracks, np.int64), np.asarray(steps, np.int64))
        known = np.maximum(track, 0)
        offset = step - self.track_step[known]
        present = (track >= 0) & (offset >= 0) & (offset < self.length[known])
        return np.where(present, self.track_start[known] + offset, -1)

    def gather_histories(self, tracks: ArrayLike, steps: ArrayLike, length: int = HISTORY) -> Float32:
        """Observed pasts, for any broadcastable tracks and steps of shape [...].

        Returns:
            float32 [..., length, 5]: x, y, sin(yaw), cos(yaw), speed; the last row is at `steps`; NaN rows where
            the track is absent, its detection was dropped, or its index is -1.
        """
        back = np.arange(1 - length, 1)
        rows = self.rows(np.asarray(tracks)[..., None], np.asarray(steps)[..., None] + back)
        x, y, yaw, speed = np.moveaxis(self.observed[rows], -1, 0)
        past = np.stack([x, y, np.sin(yaw), np.cos(yaw), speed], axis=-1)
        past[(rows < 0) | ~self.seen[rows]] = np.nan
        return past

    def history(self, tracks: ArrayLike, step: int, length: int = HISTORY) -> Float32:
        """Observed pasts of several tracks at one step: float32 [n, length, 5], see `gather_histories`."""
        return self.gather_histories(tracks, step, length)

    def gather_futures(
        self,
        tracks: ArrayLike,
        steps: ArrayLike,
        length: int = FUTURE,
        source: Literal["label", "truth"] = "label",
    ) -> Float32:
        """Positions after now: float32 [..., length, 2], row 0 one step after `steps`, NaN where unknown."""
        rows = self.rows(np.asarray(tracks)[..., None], np.asarray(steps)[..., None] + np.arange(1, length + 1))
        future = (self.label if source == "label" else self.truth)[rows, :2]
        future[rows < 0] = np.nan
        return future

    def label_future(self, track: int, step: int) -> Float32:
        """float32 [FUTURE, 2], the positions a forecast is scored on (with label noise)."""
        return self.gather_futures(track, step)

    def truth_future(self, track: int, step: int) -> Float32:
        """float32 [FUTURE, 2], the positions without label noise."""
        return self.gather_futures(track, step, source="truth")

    def neighbours(self, tracks: ArrayLike, steps: ArrayLike, k: int, seen_only: bool = True) -> Int64:
        """The k nearest other tracks at each step, by observed position, nearest first.

        Args:
            tracks: [B] the tracks in the middle, present at their steps.
            steps: [B] simulation steps.
            k: how many.
            seen_only: leave out tracks whose detection is dropped at that very step.

        Returns:
            int64 [B, k], -1 where there are fewer.
        """
        track, step = np.asarray(tracks, np.int64), np.asarray(steps, np.int64)
        others = self._present(step)
        rows = self.rows(others, step[:, None])
        centre = self.observed[self.rows(track, step), :2]
        distance = np.square(self.observed[rows, :2] - centre[:, None]).sum(axis=-1)
        absent = (rows < 0) | (others == track[:, None])
        distance[absent | ~self.seen[rows] if seen_only else absent] = np.inf
        nearest = np.argsort(distance, axis=1, kind="stable")[:, :k]
        found = np.where(
            np.isfinite(np.take_along_axis(distance, nearest, 1)), np.take_along_axis(others, nearest, 1), -1
        )
        return np.pad(found, ((0, 0), (0, k - found.shape[1])), constant_values=-1)

    def scene(
        self, track: int, step: int, *, radius: float = 60.0, extent: float = 160.0, max_targets: int = 8
    ) -> Scene:
        """What a vehicle at the track's place would know at that step.

        The frame `local` is the network frame moved so that the ego's observed centre now is the origin, axes
        unchanged. Agent 0 is the ego, the others follow by distance; those never seen in the history are left
        out.

        Args:
            track: the ego, seen at `step`.
            step: simulation step of now.
            radius: agents farther from the ego are left out, metres.
            extent: side of the square raster window around the ego, metres; zero off the network.
            max_targets: forecast at most this many: the ego and the nearest seen now with a whole future.

        Raises:
            DataError: the track is absent or not seen at that step.
        """
        row = int(self.rows(track, step))
        if row < 0 or not self.seen[row]:
            raise DataError(
                f"track {track} of {self.name} is not observed at step {step}; choose one of `windows`"
            )
        centre = self.observed[row, :2].astype(np.float64)
        agents = self._around(track, step, centre, radius)
        past = self.history(agents, step)
        past[..., :2] -= centre
        future = self.gather_futures(agents, step) - centre
        whole = np.isfinite(future).all(axis=(1, 2)) & np.isfinite(past[:, -1]).all(axis=1)
        targets = np.append(0, 1 + np.flatnonzero(np.asarray(whole)[1:]))[:max_targets]
        raster, corner = self._crop(centre, extent)
        stops = self.stops - np.append(centre, 0.0)
        return Scene(
            past=past,
            size=self.size[agents],
            kind=self.kind[agents],
            target=targets,
            raster=raster,
            channels=self.channels,
            origin=(corner - centre).astype(np.float32),
            resolution=self.resolution,
            step=self.step,
            stops=stops[(np.abs(stops[:, :2]) <= 0.5 * extent).all(axis=1)].astype(np.float32),
            frame="local",
            future=future.astype(np.float32),
        )

    def save(self, path: Path) -> None:
        """Write one compressed npz file; either all of it appears or nothing does."""
        content: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        write_npz(path, {"format": _FORMAT, **content})

    @classmethod
    def load(cls, path: Path) -> "TrackSet":
        """Read a file written by `save`.

        Raises:
            DataError: no such file, not a track set, or arrays that do not fit together.
        """
        content: dict[str, Any] = dict(read_npz(path, DataError))
        found = str(content.pop("format", "none"))
        if found != _FORMAT or set(content) != {field.name for field in fields(cls)}:
            raise DataError(f"{path} has format {found}, expected {_FORMAT}; run hcnaf simulate again")
        content["channels"] = tuple(str(name) for name in np.atleast_1d(content["channels"]))
        for name, kind in (("resolution", float), ("step", float), ("name", str)):
            content[name] = kind(content[name])
        return cls(**content)

    @cached_property
    def _by_step(self) -> tuple[int, Int64, Int64]:
        """(first step, indptr, tracks): tracks[indptr[s]:indptr[s + 1]] are present at step first + s."""
        track = np.repeat(np.arange(self.count), self.length)
        step = np.arange(len(track)) - np.repeat(self.track_start[:-1] - self.track_step, self.length)
        first = int(step.min(initial=np.iinfo(np.int64).max)) if len(step) else 0
        order = np.argsort(step, kind="stable")
        counts = np.bincount(step - first)
        return first, np.append(0, np.cumsum(counts)), track[order]

    def _present(self, steps: Int64) -> Int64:
        """The tracks present at each of [B] steps: int64 [B, m], -1 padded."""
        first, indptr, tracks = self._by_step
        at = np.clip(steps - first, 0, len(indptr) - 2)
        count = indptr[at + 1] - indptr[at]
        slot = np.arange(int(count.max(initial=0)))
        filled = slot < count[:, None]
        return np.where(filled, tracks[np.where(filled, indptr[at][:, None] + slot, 0)], -1)

    def _around(self, track: int, step: int, centre: NDArray[np.float64], radius: float) -> Int64:
        """The ego, then the observed agents within the radius by distance: int64 [m]."""
        agents = self.agents_at(step)
        distance = np.hypot(*(self.observed[self.rows(agents, step), :2] - centre).T)
        known = np.isfinite(self.history(agents, step)).any(axis=(1, 2))
        others = (agents != track) & (distance <= radius) & known
        order = np.argsort(distance[others], kind="stable")
        return np.append(np.int64(track), agents[others][order])

    def _crop(self, centre: NDArray[np.float64], extent: float) -> tuple[NDArray[np.int8], NDArray[np.float64]]:
        """A square of the raster on whole pixels, zero off the map, and its corner in network coordinates."""
        pixels = round(extent / self.resolution)
        col, row = np.floor((centre - 0.5 * extent - self.origin) / self.resolution).astype(int)
        window = np.zeros((len(self.channels), pixels, pixels), dtype=np.int8)
        height, width = self.raster.shape[1:]
        rows = slice(max(row, 0), max(min(row + pixels, height), 0))
        cols = slice(max(col, 0), max(min(col + pixels, width), 0))
        piece = self.raster[:, rows, cols]
        r, c = rows.start - row, cols.start - col
        window[:, r : r + piece.shape[1], c : c + piece.shape[2]] = piece
        return window, self.origin + np.array([col, row]) * self.resolution


class Dataset:
    """A directory of track sets with a manifest, as `hcnaf simulate` leaves it.

    Args:
        directory: holds `dataset.json` and the files it names.

    Raises:
        DataError: no manifest, or one of another format or version.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = Path(directory)
        self.manifest = read_manifest(self.directory / "dataset.json")

    def split(self, name: Split) -> list[TrackSet]:
        """The track sets of a split, read now.

        Raises:
            DataError: no such split, or a file that cannot be read.
        """
        entries = self.manifest.splits.get(name)
        if entries is None:
            known = ", ".join(self.manifest.splits)
            raise DataError(f"{self.directory} has no split {name!r}, it has {known}; choose one of these")
        return [TrackSet.load(self.directory / entry.file) for entry in entries]


def _check_shapes(tracks: TrackSet) -> None:
    sizes: dict[str, int] = {"C": len(tracks.channels)}
    for name, (dtype, shape) in _ARRAYS.items():
        array = getattr(tracks, name)
        fits = array.dtype == dtype and array.ndim == len(shape)
        for found, wanted in zip(array.shape, shape, strict=False):
            fits = fits and found == (wanted if isinstance(wanted, int) else sizes.setdefault(wanted, found))
        if not fits:
            raise DataError(
                f"{name} of {tracks.name} is {array.dtype} {array.shape}, expected {np.dtype(dtype)} {shape} "
                f"with {sizes}; simulate again"
            )


def _check_indices(tracks: TrackSet) -> None:
    start, count = tracks.track_start, len(tracks.track_step)
    ordered = len(start) == count + 1 and start[0] == 0 and start[-1] == len(tracks.truth)
    if not (ordered and (np.diff(start) > 0).all()):
        raise DataError(f"track_start of {tracks.name} does not divide {len(tracks.truth)} rows; simulate again")
    track, step = tracks.windows.T
    if ((track < 0) | (track >= count)).any() or (tracks.rows(track, step) < 0).any():
        raise DataError(f"windows of {tracks.name} point outside its {count} tracks; simulate again")
