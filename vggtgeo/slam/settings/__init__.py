"""What a run may be told: the numbers of its stages, who plays which role, presets, tables in files."""
