"""Who drives: vehicle bodies and characters, drawn as SUMO vehicle types."""

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

TYPES = 48
"""Vehicle types drawn per network; every vehicle is of one of them."""


class Body(NamedTuple):
    """Ranges of one class of vehicle: metres and m/s²."""

    share: float
    length: tuple[float, float]
    width: tuple[float, float]
    accel: tuple[float, float]
    decel: tuple[float, float]


BODIES = {
    "car": Body(0.70, (3.6, 5.0), (1.65, 1.95), (1.8, 3.2), (3.5, 5.0)),
    "van": Body(0.12, (4.8, 6.2), (1.9, 2.1), (1.4, 2.4), (3.2, 4.5)),
    "truck": Body(0.06, (7.0, 10.5), (2.3, 2.55), (0.8, 1.4), (2.8, 4.0)),
    "bus": Body(0.04, (10.0, 12.5), (2.45, 2.55), (0.8, 1.3), (2.5, 3.5)),
    "motorcycle": Body(0.08, (1.9, 2.4), (0.7, 0.95), (2.5, 5.0), (4.0, 6.5)),
}


def draw_body(rng: np.random.Generator) -> tuple[str, float, float]:
    """(class name, length, width) of a random vehicle, metres on a centimetre grid."""
    names = list(BODIES)
    name = names[int(rng.choice(len(names), p=[body.share for body in BODIES.values()]))]
    body = BODIES[name]
    return name, round(float(rng.uniform(*body.length)), 2), round(float(rng.uniform(*body.width)), 2)


def write_drivers(path: Path, violators: float, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """Write TYPES random vehicle types as a SUMO additional file.

    Args:
        path: the file to write.
        violators: share of types that sometimes ignore foes, lights and limits.
        rng: draws bodies and characters.

    Returns:
        (length, width) in metres of each type's box, by its id.
    """
    root = ElementTree.Element("additional")
    sizes = {}
    for i in range(TYPES):
        name, length, width = draw_body(rng)
        character = _body(name, rng) | _following(rng) | _steering(rng)
        if rng.random() < violators:
            character |= _violations(rng)
        kind = f"{name}{i}"
        sizes[kind] = (length, width)
        shape = {"id": kind, "vClass": "passenger", "length": f"{length:.2f}", "width": f"{width:.2f}"}
        ElementTree.SubElement(root, "vType", shape | character)
    ElementTree.ElementTree(root).write(path)
    return sizes


def _body(name: str, rng: np.random.Generator) -> dict[str, str]:
    body = BODIES[name]
    return {
        "accel": _uniform(rng, *body.accel),
        "decel": _uniform(rng, *body.decel),
        "emergencyDecel": "8.0",
        "maxSpeed": "22" if name in ("truck", "bus") else "40",
    }


def _following(rng: np.random.Generator) -> dict[str, str]:
    """Two car-following models; Krauss drivers dawdle, in spells (sigmaStep) and not at every step."""
    character = {
        "speedFactor": f"normc({rng.normal(0.97, 0.08):.3f},{rng.uniform(0.03, 0.12):.3f},0.6,1.3)",
        "minGap": _uniform(rng, 1.2, 3.0),
        "tau": _uniform(rng, 0.8, 1.8),
        "impatience": _uniform(rng, 0.0, 0.5),
    }
    if rng.random() < 0.5:
        return character | {"carFollowModel": "IDM"}
    return character | {
        "carFollowModel": "Krauss",
        "sigma": _uniform(rng, 0.1, 0.7),
        "sigmaStep": _uniform(rng, 0.5, 2.0),
    }


def _steering(rng: np.random.Generator) -> dict[str, str]:
    """Where in the lane a driver keeps, how far he wanders, how readily he changes lanes."""
    sides = ("center", "center", "center", "right", "left", "arbitrary", "nice", f"{rng.normal(0.0, 0.3):.2f}")
    return {
        "latAlignment": sides[int(rng.integers(len(sides)))],
        "lcSigma": _uniform(rng, 0.05, 0.3),
        "maxSpeedLat": _uniform(rng, 0.5, 1.2),
        "minGapLat": _uniform(rng, 0.3, 0.7),
        "lcSpeedGain": _uniform(rng, 0.5, 4.0),
        "lcCooperative": _uniform(rng, 0.3, 1.0),
        "lcAssertive": _uniform(rng, 0.8, 1.6),
        "lcKeepRight": _uniform(rng, 0.2, 2.0),
    }


def _violations(rng: np.random.Generator) -> dict[str, str]:
    """SUMO ignores foes only below jmIgnoreFoeSpeed, whose default is 0: it has to be raised too."""
    return {
        "jmIgnoreFoeProb": _uniform(rng, 0.2, 0.9),
        "jmIgnoreFoeSpeed": _uniform(rng, 4.0, 12.0),
        "jmIgnoreJunctionFoeProb": _uniform(rng, 0.0, 0.3),
        "jmDriveAfterRedTime": _uniform(rng, 0.5, 4.0),
        "jmDriveAfterYellowTime": _uniform(rng, 2.0, 5.0),
        "speedFactor": f"normc({rng.uniform(1.05, 1.35):.3f},0.08,0.8,1.6)",
    }


def _uniform(rng: np.random.Generator, low: float, high: float) -> str:
    return f"{rng.uniform(low, high):.3f}"
