"""Structured nonlinear least squares on optimistix and lineax. Knows nothing of cameras."""
