"""What every room shares: geometry, messages, link, camera, controller and the ONNX signature."""
