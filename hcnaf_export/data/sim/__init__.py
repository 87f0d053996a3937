"""The virtual simulator: SUMO traffic on generated or given networks, recorded as track sets (extra `sim`).

SimSettings ──> streets (netgenerate) ──> roadmap (raster, stops) ─┐
                             └─────────> traffic (libsumo) ────────┴─> recording (noise, windows) ──> TrackSet
"""

from hcnaf_export.data.sim.generate import simulate
from hcnaf_export.data.sim.settings import SimSettings

__all__ = ["SimSettings", "simulate"]
