"""Errors and files: what everything else may use."""
