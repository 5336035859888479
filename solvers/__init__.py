"""Structured nonlinear least squares on optimistix. Knows nothing of cameras."""
