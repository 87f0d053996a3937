"""The paper's own experiments, each by one command: train, export, score through onnxruntime, compare.

Request ──> an experiment's `run` ──> Record ──> record.json, table, figure
"""
