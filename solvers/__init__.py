"""Structured nonlinear least squares on optimistix, independent of cameras."""
