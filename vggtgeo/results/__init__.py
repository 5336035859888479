"""Results of a run: in memory, written to a folder, and read from a folder."""
