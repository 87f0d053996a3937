r"""Extra nats: how far the forecast of slightly perturbed labels is from the best one possible.

    e = (H(p', p_model) - H(eta)) / D,   D = 2,   H(eta) = 1 + log(2 pi sigma^2)   nats per m² and step

p' is the distribution of the recorded labels with Gaussian noise eta of standard deviation sigma added to x and
y, H(p', p_model) the mean of -log p_model at such points. Noise cannot be foretold, so e >= 0 for any forecast. It
does not depend on units, only on the size of sigma, about which published numbers differ:

    normalised   sigma = 0.01 after metres are divided by 50, which is 0.5 m: the code published with HCNAF
    metres       sigma = 0.01 m: PRECOG, which scores the joint density of all steps

Here both are means over horizons of each horizon's own (marginal) density, as in HCNAF's code. The third number to
report beside them is the plain NLL of the labels in nats per m² and step, which is the rest of an evaluation.

Labels that were recorded with noise of their own cannot be foretold better than that noise: where its standard
deviation l is known, e is at least `floor` = log(1 + l^2 / sigma^2) / 2.

References:
    Rhinehart et al., PRECOG, ICCV 2019 (extra nats). Oh & Valois, HCNAF, CVPR 2020.
"""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.tracks import TrackSet
from hcnaf_export.evaluation.spread import mean_and_error

Float = NDArray[np.float64]
Int = NDArray[np.int64]

UNIT = 50.0
"""Metres per unit of HCNAF's normalised coordinates."""

SEED = 1


class Protocol(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A way to perturb labels: its name, the noise's standard deviation (m), and what it is in words."""

    name: str
    sigma: float
    definition: str


PROTOCOLS = (
    Protocol("normalised", 0.01 * UNIT, "sigma = 0.01 of metres / 50 (0.5 m), marginals, HCNAF's published code"),
    Protocol("metres", 0.01, "sigma = 0.01 m, marginals; PRECOG has this sigma and scores the joint density"),
)


class ExtraNatsRow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One horizon (s): extra nats per dimension and their standard error."""

    horizon: float
    extra_nats: float
    error: float


class ExtraNats(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Extra nats of one protocol.

    Attributes:
        protocol: its name. sigma: of the noise, m. definition: in words.
        rows: one per horizon.
        mean: over the horizons. mean_error: its standard error.
        floor: what the recorded labels' own noise leaves at least; 0 where it is not known.
    """

    protocol: str
    sigma: float
    definition: str
    rows: tuple[ExtraNatsRow, ...]
    mean: float
    mean_error: float
    floor: float


def perturbed(tracks: TrackSet, protocol: Protocol) -> TrackSet:
    """The tracks with noise added to every label, the same noise each time."""
    rng = np.random.default_rng((SEED, len(tracks.label)))
    noise = protocol.sigma * rng.standard_normal(tracks.label.shape)
    return replace(tracks, label=(tracks.label + noise).astype(np.float32))


def extra_nats(nll: Float, protocol: Protocol) -> Float:
    """e from -log p (nats per m²) at perturbed labels."""
    return (nll - noise_entropy(protocol.sigma)) / 2.0


def noise_entropy(sigma: float) -> float:
    """H(eta) in nats per m² of noise with the standard deviation `sigma` (m) in x and y."""
    return 1.0 + math.log(2.0 * math.pi * sigma * sigma)


def summarise_extra_nats(
    horizons: tuple[float, ...], nll: Float, cluster: Int, protocol: Protocol, label_noise: float
) -> ExtraNats:
    """Scores from -log p [W, Q] at labels perturbed by `protocol`, and each window's cluster [W]."""
    values = extra_nats(nll, protocol)
    means, errors = mean_and_error(values, cluster)
    mean, error = mean_and_error(values.mean(axis=1, keepdims=True), cluster)
    return ExtraNats(
        protocol=protocol.name,
        sigma=protocol.sigma,
        definition=protocol.definition,
        rows=tuple(ExtraNatsRow(t, float(m), float(e)) for t, m, e in zip(horizons, means, errors, strict=True)),
        mean=float(mean[0]),
        mean_error=float(error[0]),
        floor=0.5 * math.log1p((label_noise / protocol.sigma) ** 2),
    )
