"""From a training checkpoint to the three ONNX graphs a board runs, gated by parity."""
