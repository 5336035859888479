"""Errors, argument validation and files, for use by all other packages."""
