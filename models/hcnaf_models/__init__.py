"""The mathematics of HCNAF in PyTorch."""
