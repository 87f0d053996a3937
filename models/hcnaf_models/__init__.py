"""The mathematics of HCNAF in PyTorch: flow, hyper-networks, configurations."""

from hcnaf_models.config import ConditionConfig, Crop, ModelConfig, PomConfig, from_dict, to_dict
from hcnaf_models.model import Hcnaf, build
from hcnaf_models.spec import FlowSpec

__all__ = [
    "ConditionConfig",
    "Crop",
    "FlowSpec",
    "Hcnaf",
    "ModelConfig",
    "PomConfig",
    "build",
    "from_dict",
    "to_dict",
]
