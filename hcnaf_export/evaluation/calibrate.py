"""Calibration of a predictor, as far as it can be measured: what it is in `pit`, `regions` and `reliability`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hcnaf_export.evaluation import pit, regions, reliability
from hcnaf_export.evaluation.capabilities import Drawer, Mapper, Predictor, Transformer
from hcnaf_export.evaluation.progress import Stages
from hcnaf_export.evaluation.subset import Part, cluster_of

CALIBRATED = 2000
"""Windows whose calibration is measured, unless told otherwise."""

COST = 1, 2, 12
"""Work of the three measures, for a window, in units of its NLL."""

MOST_CELLS = 50
"""Windows whose maps are held at once."""


class Calibration(NamedTuple):
    """What was measured; None where the predictor cannot."""

    pit: pit.PitScores | None = None
    regions: regions.RegionScores | None = None
    reliability: reliability.ReliabilityScores | None = None


def calibrate(
    predictor: Predictor, some: Sequence[Part], horizons: tuple[float, ...], stages: Stages
) -> Calibration:
    """All that the predictor allows, on some windows."""
    return Calibration(
        _pit(predictor, some, horizons, stages),
        _regions(predictor, some, horizons, stages),
        _reliability(predictor, some, horizons, stages),
    )


def _pit(
    predictor: Predictor, some: Sequence[Part], horizons: tuple[float, ...], stages: Stages
) -> pit.PitScores | None:
    if not isinstance(predictor, Transformer) or not predictor.transforms:
        return None
    found = []
    for part in some:
        found.append(predictor.pit(part.tracks, part.windows, horizons))
        stages.done(COST[0] * len(part.windows))
    return pit.summarise_pit(horizons, np.concatenate(found), cluster_of(some))


def _regions(
    predictor: Predictor, some: Sequence[Part], horizons: tuple[float, ...], stages: Stages
) -> regions.RegionScores | None:
    if not isinstance(predictor, Drawer) or not predictor.draws:
        return None
    found = []
    for tracks, windows, _ in some:
        log_prob = -predictor.nll(tracks, windows, horizons)
        found.append(regions.denser(predictor.drawn_log_prob(tracks, windows, horizons, regions.DRAWS), log_prob))
        stages.done(COST[1] * len(windows))
    return regions.summarise_regions(horizons, np.concatenate(found), cluster_of(some))


def _reliability(
    predictor: Predictor, some: Sequence[Part], horizons: tuple[float, ...], stages: Stages
) -> reliability.ReliabilityScores | None:
    if not isinstance(predictor, Mapper) or not predictor.maps:
        return None
    found = []
    for tracks, windows, _ in some:
        for few in np.array_split(windows, -(-len(windows) // MOST_CELLS)):
            found.append(reliability.tally(*predictor.cells(tracks, few, horizons, reliability.GRID)))
            stages.done(COST[2] * len(few))
    return reliability.summarise_reliability(horizons, reliability.joined(found), cluster_of(some))
