"""The perception roles: their protocols (`roles`), classical code (`classical`) and networks (`onnx`, `exporters`)."""
