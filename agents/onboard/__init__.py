"""Agents on a camera: exported to ONNX, and run without torch."""
