"""The published networks behind ONNX: what their files must look like, one session for all, one adapter a role."""
