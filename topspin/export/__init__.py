"""`topspin export`: a policy as a folder for a robot. Needs ``onnx`` and ``onnxruntime`` (extra ``export``)."""
