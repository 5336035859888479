"""Settings of a run: numbers by stage, implementations of the roles, presets, and tables in files."""
