"""From a training checkpoint to the ONNX graphs a board runs, gated by parity."""
