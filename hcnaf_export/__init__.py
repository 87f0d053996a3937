"""The training side of HCNAF: data, training, evaluation, ONNX graphs, export and parity (PyTorch)."""
