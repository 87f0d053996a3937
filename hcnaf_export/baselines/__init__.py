"""What HCNAF is compared with: constant velocity with Gaussian errors, other densities on the same encoders."""

from hcnaf_export.baselines.constant_velocity import ConstantVelocityGaussian, label_steps, labels
from hcnaf_export.baselines.heads import build, make_any_head

__all__ = ["ConstantVelocityGaussian", "build", "label_steps", "labels", "make_any_head"]
