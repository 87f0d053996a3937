"""What a simulated data set is made of."""

import math

import msgspec

from hcnaf_export.data.manifest import NoiseModel, Split
from hcnaf_runtime.errors import DataError


class SimSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `simulate`; the defaults make the data set the embedded model is trained on.

    Attributes:
        seed: everything random follows from it.
        train_networks, val_networks, test_networks: generated networks per split; all differ.
        train_windows, val_windows, test_windows: snippets per split, spread evenly over its networks.
        train_nets, val_nets, test_nets: `.net.xml` or `.net.xml.gz` files to use in place of a split's generated
            networks.
        seconds: recorded time per network.
        warm_up: simulated time before the recording starts, seconds.
        density: moving vehicles per kilometre of lane.
        max_vehicles: at most so many moving vehicles at once.
        parked: parked vehicles per kilometre of street side.
        violators: share of drivers who sometimes ignore priority, lights or speed limits.
        sudden_stops: unprovoked stops and slow-downs, per vehicle and minute.
        standing_share: at most this share of the windows is of vehicles that stand for the whole future.
        turning_share: windows that turn by more than 30 degrees in 4 s are kept up to this share.
        resolution: metres per pixel of the map raster.
        noise: the recorded perception and label noise.
        jobs: networks simulated at the same time, one process each; the result does not depend on it.

    Raises:
        DataError: a negative or infinite number, or a share above 1.
    """

    seed: int = 0
    train_networks: int = 16
    val_networks: int = 4
    test_networks: int = 4
    train_windows: int = 50_000
    val_windows: int = 5_000
    test_windows: int = 5_000
    train_nets: tuple[str, ...] = ()
    val_nets: tuple[str, ...] = ()
    test_nets: tuple[str, ...] = ()
    seconds: float = 300.0
    warm_up: float = 60.0
    density: float = 9.0
    max_vehicles: int = 80
    parked: float = 7.0
    violators: float = 0.15
    sudden_stops: float = 0.5
    standing_share: float = 0.15
    turning_share: float = 0.3
    resolution: float = 0.5
    noise: NoiseModel = NoiseModel()
    jobs: int = 1

    def __post_init__(self) -> None:
        for name in ("standing_share", "turning_share", "violators"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise DataError(f"{name} is {getattr(self, name)}; expected a share from 0 to 1")
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if isinstance(value, int | float) and not (value >= 0 and math.isfinite(value)):
                raise DataError(f"{name} is {value}; expected a finite number that is not negative")

    def networks(self, split: Split) -> int:
        """How many networks a split has."""
        return (
            len(self.nets(split))
            or {
                "train": self.train_networks,
                "val": self.val_networks,
                "test": self.test_networks,
            }[split]
        )

    def nets(self, split: Split) -> tuple[str, ...]:
        """The given network files of a split, empty for generated networks."""
        return {"train": self.train_nets, "val": self.val_nets, "test": self.test_nets}[split]

    def windows(self, split: Split) -> int:
        """How many windows a split has."""
        return {"train": self.train_windows, "val": self.val_windows, "test": self.test_windows}[split]
